"""Parameter search by many runs: an Optuna study, stored in a journal file (the extra `tune`).

The next trial is chosen by tree-structured Parzen estimators (Bergstra et al. 2011).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from impslam.errors import ConfigError, ImpError
from impslam.extras import install
from impslam.sweeps.cases import Case, Settings
from impslam.sweeps.measures import run_case
from impslam.sweeps.pool import Pool, ProcessDied
from impslam.sweeps.rows import Row
from impslam.sweeps.space import Space
from impslam.sweeps.verdict import MEASURES

JOURNAL = "study.journal"
SCORES = {
    "best": tuple(MEASURES),
    "truth": ("ate_m",),
    "relations": ("relation_m",),
    "quality": ("disagreement_m",),
    "likelihood": ("nll",),
}
"""Columns of the table used as scores: the first one that is available for a log."""
HELP = {
    "truth": "give --truth FILE, or choose another --score",
    "relations": "give --relations FILE, or choose another --score",
    "likelihood": "only an estimator that matches landmarks has innovations: --set "
    "estimator.kind=landmarks",
}
MESSAGE = "message"

Progress: TypeAlias = Callable[[str, int, int], None]


def open_study(
    folder: Path,
    base: Mapping[str, Any],
    space: Space,
    evidence: Mapping[str, Any] | None = None,
) -> Any:
    """Open the study of a folder, or create one.

    The first trial of a new study is the config itself.

    Parameters
    ----------
    base : the configured values of the searched parameters, by key
    evidence : what the scores depend on besides these, for JSON; see `Task.evidence`

    Raises
    ------
    ConfigError
        If the extra is not installed, or the existing study has another search space or other evidence.
    """
    try:
        import optuna  # noqa: PLC0415  # an extra
        from optuna.storages import JournalStorage  # noqa: PLC0415
        from optuna.storages.journal import JournalFileBackend  # noqa: PLC0415
    except ImportError:
        raise ConfigError(f"imp tune needs Optuna; install it with `{install('tune')}`") from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(folder / JOURNAL))),
        study_name="tune",
        direction="minimize",
        load_if_exists=True,
    )
    searched = {"space": {key: repr(part) for key, part in space.items()}, **(evidence or {})}
    before = study.user_attrs or searched
    if others := [name for name in searched if before.get(name) != searched[name]]:
        text = f"contains another search (with other {', '.join(others)})"
        raise ConfigError(f"{folder}: {text}; give another -o")
    for name, value in searched.items():
        study.set_user_attr(name, value)
    # Each continuation has a seed of its own: the same one would suggest the first trials again.
    study.sampler = optuna.samplers.TPESampler(
        seed=len(study.trials), n_startup_trials=2 * len(space) + 4
    )
    if not study.trials:
        first = {key: part.suggestion(base[key]) for key, part in space.items()}
        study.enqueue_trial({key: value for key, value in first.items() if value is not None})
    return study


def run_cases(cases: Sequence[Case]) -> list[Row]:
    """Run the cases of one trial sequentially."""
    return [run_case(case) for case in cases]


def search(
    study: Any,
    cases: Callable[[Any], list[Case]],
    score: str,
    pool: Pool,
    trials: int,
    progress: Progress,
    work: Callable[[Sequence[Case]], list[Row]] = run_cases,
) -> None:
    """Run trials until the study has the requested number.

    A trial that fails, or whose process is killed, counts; its `message` is the reason.

    Parameters
    ----------
    cases : returns the runs that evaluate a trial
    score : one of `SCORES`

    Raises
    ------
    ConfigError
        If the score of a trial is unknown, and no trial has one.
    """
    from optuna.trial import TrialState  # noqa: PLC0415  # an extra

    for trial in study.get_trials(states=(TrialState.RUNNING,)):  # of an interrupted search
        study.tell(trial.number, state=TrialState.FAIL)
        study.enqueue_trial(trial.params)
    left = max(0, trials - len(finished(study)))
    started: list[Any] = []

    def suggestions() -> Iterator[list[Case]]:
        for _ in range(left):
            started.append(study.ask())
            yield cases(started[-1])

    progress("trials", 0, left)
    for done, (index, rows) in enumerate(pool.each(work, suggestions()), start=1):
        _report(study, started[index], rows, score)
        progress("trials", done, left)


def _report(study: Any, trial: Any, rows: Sequence[Row] | ProcessDied, score: str) -> None:
    from optuna.trial import TrialState  # noqa: PLC0415  # an extra

    outcome = [{"error": rows.why}] if isinstance(rows, ProcessDied) else rows
    unknown, message = None, next((row["error"] for row in outcome if row["error"]), "")
    if not message:
        try:
            study.tell(trial, score_of(outcome, score))
        except ConfigError as error:
            unknown, message = error, str(error)
        else:
            return
    trial.set_user_attr(MESSAGE, message)
    study.tell(trial, state=TrialState.FAIL)
    if unknown and not any(t.values for t in study.trials):
        raise unknown


def finished(study: Any) -> list[Any]:
    """Return the trials that have a score or failed; interrupted ones are left out."""
    return [t for t in study.trials if t.values or MESSAGE in t.user_attrs]


def best(study: Any) -> Any:
    """Return the best trial.

    Raises
    ------
    ImpError
        If all trials failed.
    """
    known = [trial for trial in study.trials if trial.values]
    if not known:
        why = next((t.user_attrs[MESSAGE] for t in finished(study)), "none was run")
        raise ImpError(f"no trial gave a score; the first: {why}")
    return min(known, key=lambda trial: float(trial.value))


def suggest(space: Space, trial: Any) -> Settings:
    """Return the settings of a trial, running or finished."""
    return tuple((key, part.suggest(trial, key)) for key, part in space.items())


def score_of(rows: Sequence[Row], score: str) -> float:
    """Return the score of runs; lower is better.

    For errors it is the geometric mean, so that logs of any size have equal weight; for negative
    log-likelihoods it is the mean.

    Raises
    ------
    ConfigError
        If the score is unknown for a log.
    """
    values = [_value(row, score) for row in rows]
    if score == "likelihood":
        return math.fsum(values) / len(values)
    return math.exp(math.fsum(math.log(max(value, 1e-9)) for value in values) / len(values))


def _value(row: Row, score: str) -> float:
    for name in SCORES[score]:
        value = row.get(name)
        if value is not None and math.isfinite(value):
            return float(value)
    raise ConfigError(f"{row['log']}: {unknown(score)}")


def unknown(score: str) -> str:
    """Say that the score of a log is unknown, and what to do."""
    return f"its {score} score is unknown; {HELP.get(score, 'choose another --score')}"
