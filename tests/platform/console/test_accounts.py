import base64
import logging
import stat
import unicodedata

import pytest

from impslam.platform.console import accounts as module
from impslam.platform.console.accounts import Accounts, AccountsError, write_private
from impslam.platform.console.authenticator import (
    CACHE_LIFETIME,
    LINK_INTERVAL,
    LINK_LIFETIME,
    Authenticator,
    LoginRefused,
)
from impslam.platform.console.refusals import (
    FIRST,
    LINE_BURST,
    MAX_KINDS,
    WINDOW,
    Refusals,
    sanitised,
)
from impslam.platform.console.session import IDLE_TIMEOUT, LIFETIME, Session
from impslam.platform.console.session_store import MAX_PER_ADDRESS, MAX_SESSIONS, Sessions
from impslam.platform.console.throttle import (
    FREE_TRIES,
    MAX_WAIT,
    RESET_TIME,
    TRIES_PER_MINUTE,
    Bucket,
    Throttle,
)

DRIVE, WATCH = "drive-password", "watch-password"


class Hand:
    """A clock that is set manually."""

    def __init__(self):
        self.moment = 1000.0

    def __call__(self):
        return self.moment


@pytest.fixture
def clock():
    return Hand()


@pytest.fixture
def accounts(tmp_path):
    made = Accounts(tmp_path / "new" / "accounts.json")
    made.set("drive", DRIVE)
    made.set("watch", WATCH)
    return made


class TestAccounts:
    def test_each_password_gives_its_right_and_nothing_else_gives_any(self, accounts):
        assert accounts.rights() == {"drive", "watch"}
        assert accounts.right(DRIVE) == "drive"
        assert accounts.right(WATCH) == "watch"
        for wrong in ("", DRIVE[:-1], DRIVE + " ", DRIVE.upper(), "\0", "\ud800", "x" * 100_000):
            assert accounts.right(wrong) is None

    def test_without_a_file_there_is_no_right(self, tmp_path):
        nobody = Accounts(tmp_path / "none.json")
        assert nobody.rights() == frozenset()
        assert nobody.right("") is None

    def test_the_file_is_private_and_holds_no_password(self, accounts):
        assert stat.S_IMODE(accounts.path.stat().st_mode) == 0o600
        assert stat.S_IMODE(accounts.path.parent.stat().st_mode) == 0o700
        assert "password" not in accounts.path.read_text()

    @pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o644, 0o610])
    def test_a_file_that_others_can_read_is_refused(self, accounts, mode):
        accounts.path.chmod(mode)
        with pytest.raises(AccountsError, match="chmod 600"):
            accounts.right(DRIVE)
        with pytest.raises(AccountsError, match="chmod 600"):
            accounts.rights()

    @pytest.mark.parametrize(
        "text",
        [
            "",
            "{",
            "[]",
            '{"salt": 3}',
            '{"salt": "AAAA", "drive": "AAAA", "root": "AAAA"}',
            '{"salt": "AAAA", "cost": {"blocks": 1000000000}}',
        ],
    )
    def test_a_broken_file_is_a_one_line_error(self, accounts, text):
        accounts.path.write_text(text)
        with pytest.raises(AccountsError, match="remove it") as messages:
            accounts.right(DRIVE)
        assert "\n" not in str(messages.value)

    @pytest.mark.parametrize("password", ["", "short77", "x" * 257])
    def test_too_short_and_too_long_are_refused(self, accounts, password):
        with pytest.raises(AccountsError, match="8 to 256"):
            accounts.set("drive", password)
        assert accounts.right(DRIVE) == "drive"

    def test_characters_beyond_the_maximum_length_count(self, accounts):
        accounts.set("drive", "x" * 256)
        assert accounts.right("x" * 256) == "drive"
        assert accounts.right("x" * 257) is None

    def test_both_rights_cannot_have_the_same_password(self, accounts):
        with pytest.raises(AccountsError, match="other right"):
            accounts.set("watch", DRIVE)
        accounts.set("drive", DRIVE)  # its own anew is no matter
        assert accounts.right(WATCH) == "watch"

    def test_a_password_does_not_depend_on_unicode_composition(self, accounts):
        accounts.set("drive", unicodedata.normalize("NFC", "Überfährt"))
        assert accounts.right(unicodedata.normalize("NFD", "Überfährt")) == "drive"

    def test_removing_one_password_keeps_the_other(self, accounts):
        accounts.remove("drive")
        assert accounts.rights() == {"watch"}
        assert accounts.right(DRIVE) is None

    def test_a_file_with_an_older_cost_is_accepted(self, accounts, monkeypatch):
        monkeypatch.setattr(module, "BLOCKS", 2**4)
        assert accounts.right(DRIVE) == "drive"

    def test_the_version_changes_with_the_file(self, accounts, tmp_path):
        before = accounts.version()
        assert Accounts(accounts.path).version() == before
        accounts.set("drive", "another password")
        assert accounts.version() != before
        assert Accounts(tmp_path / "none").version() == (0, 0, 0)

    def test_the_default_place(self, monkeypatch, tmp_path):
        monkeypatch.setenv("HOME", str(tmp_path))
        monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
        assert Accounts().path == tmp_path / ".config/impslam/accounts.json"
        monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "x"))
        assert Accounts().path == tmp_path / "x/impslam/accounts.json"
        monkeypatch.setenv("XDG_CONFIG_HOME", "relative")  # to be ignored, says the specification
        assert Accounts().path == tmp_path / ".config/impslam/accounts.json"

    def test_a_failed_write_leaves_the_file_unchanged(self, accounts, monkeypatch):
        before = accounts.path.read_bytes()

        def fails(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(module.os, "fsync", fails)
        with pytest.raises(AccountsError, match="No space left"):
            accounts.set("drive", "another password")
        assert accounts.path.read_bytes() == before
        assert [path.name for path in accounts.path.parent.iterdir()] == ["accounts.json"]

    def test_private_files_are_never_readable_by_others(self, tmp_path, monkeypatch):
        seen = []
        real = module.os.fsync
        monkeypatch.setattr(
            module.os,
            "fsync",
            lambda handle: seen.append(module.os.fstat(handle).st_mode) or real(handle),
        )
        write_private(tmp_path / "key", b"secret")
        assert [stat.S_IMODE(mode) for mode in seen] == [0o600]


class TestSessions:
    def test_a_token_finds_its_session_and_no_other_token_does(self, clock):
        sessions = Sessions(clock)
        token, session = sessions.begin("drive")
        other, watcher = sessions.begin("watch")
        assert sessions.find(token) is session
        assert sessions.find(other) is watcher
        assert session.may_drive
        assert not watcher.may_drive
        assert session.id not in token
        for wrong in ("", token[:-1], token + "A", session.id, "\ud800"):
            assert sessions.find(wrong) is None

    def test_tokens_have_256_bits_and_are_not_kept(self, clock):
        sessions = Sessions(clock)
        token, session = sessions.begin("drive")
        assert len(token) == 43  # base64 of 32 bytes
        assert token not in repr(vars(sessions)) + repr(vars(session))

    def test_it_ends_when_idle(self, clock):
        sessions = Sessions(clock)
        token, session = sessions.begin("drive")
        for _ in range(3):
            clock.moment += IDLE_TIMEOUT - 1.0
            session.use()
        assert session.alive()
        clock.moment += IDLE_TIMEOUT
        assert not session.alive()
        session.use()  # too late
        assert not session.alive()
        assert sessions.find(token) is None

    def test_it_ends_after_its_lifetime_even_if_used(self, clock):
        session = Session("1", "driver", may_drive=True, clock=clock)
        begun = clock.moment
        while clock.moment < begun + LIFETIME:
            assert session.alive()
            session.use()
            clock.moment += IDLE_TIMEOUT / 2.0
        assert not session.alive()

    def test_logout_ends_one_and_a_new_password_all(self, clock):
        sessions = Sessions(clock)
        (first, one), (second, two) = sessions.begin("drive"), sessions.begin("drive")
        one.end()
        assert sessions.find(first) is None
        assert sessions.find(second) is two
        sessions.end_all()
        assert sessions.find(second) is None
        assert not two.alive()

    def test_the_least_recently_used_session_ends_when_there_are_too_many(self, clock):
        sessions = Sessions(clock)
        held = []
        for k in range(MAX_SESSIONS):
            held.append(sessions.begin("watch", f"10.0.0.{k}")[1])
            clock.moment += 1.0
        held[0].use()
        _, driver = sessions.begin("drive", "10.0.1.1")
        assert all(session.alive() for session in held)
        sessions.begin("watch", "10.0.1.1")
        assert [session.alive() for session in held[:3]] == [True, False, True]
        assert driver.alive()

    def test_repeated_logins_only_end_sessions_of_the_same_address(self, clock):
        sessions = Sessions(clock)
        _, driver = sessions.begin("drive", "10.0.0.1")
        _, other = sessions.begin("watch", "10.0.0.2")
        mine = []
        for _ in range(200):
            clock.moment += 0.01
            mine.append(sessions.begin("watch", "10.0.0.1")[1])
        assert driver.alive()
        assert other.alive()
        assert sum(session.alive() for session in mine) == MAX_PER_ADDRESS


class TestThrottle:
    def test_a_few_are_free_then_the_wait_doubles(self, clock):
        throttle, waits = Throttle(clock), []
        for _ in range(14):
            wait = throttle.wait("10.0.0.1")
            waits.append(wait)
            if wait:
                clock.moment += wait
                assert throttle.wait("10.0.0.1") == 0.0
        assert waits[:FREE_TRIES] == [0.0] * FREE_TRIES
        assert waits[FREE_TRIES : FREE_TRIES + 8] == [2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0]
        assert set(waits[FREE_TRIES + 8 :]) == {MAX_WAIT}

    def test_tries_while_waiting_do_not_extend_the_wait(self, clock):
        throttle = Throttle(clock)
        for _ in range(FREE_TRIES):
            throttle.wait("10.0.0.1")
        for _ in range(1000):
            assert throttle.wait("10.0.0.1") == pytest.approx(2.0)
        clock.moment += 2.0
        assert throttle.wait("10.0.0.1") == 0.0

    def test_a_thousand_a_minute_admit_a_handful(self, clock):
        throttle, admitted = Throttle(clock), 0
        for _ in range(1000):
            admitted += throttle.wait("10.0.0.1") == 0.0
            clock.moment += 0.06
        assert admitted == FREE_TRIES + 4  # after 2, 6, 14 and 30 s

    def test_another_address_is_not_delayed(self, clock):
        throttle = Throttle(clock)
        for _ in range(1000):
            throttle.wait("10.0.0.1")
        assert throttle.wait("10.0.0.2") == 0.0

    def test_all_together_are_bounded(self, clock):
        throttle = Throttle(clock)
        admitted = sum(throttle.wait(f"10.0.{k // 250}.{k % 250}") == 0.0 for k in range(1000))
        assert admitted == TRIES_PER_MINUTE
        clock.moment += 60.0
        admitted = sum(throttle.wait(f"10.1.{k // 250}.{k % 250}") == 0.0 for k in range(1000))
        assert admitted == TRIES_PER_MINUTE

    def test_a_correct_password_or_time_resets_the_count(self, clock):
        throttle = Throttle(clock)
        for _ in range(FREE_TRIES):
            throttle.wait("10.0.0.1")
        throttle.forgive("10.0.0.1")
        assert throttle.wait("10.0.0.1") == 0.0
        for _ in range(20):
            clock.moment += throttle.wait("10.0.0.1")
        clock.moment += RESET_TIME
        assert [throttle.wait("10.0.0.1") for _ in range(FREE_TRIES)] == [0.0] * FREE_TRIES

    def test_correct_passwords_do_not_count(self, clock):
        throttle = Throttle(clock)
        for _ in range(1000):
            assert throttle.wait("10.0.0.1") == 0.0
            throttle.forgive("10.0.0.1", wholly=False)
        assert throttle.wait("10.0.0.2") == 0.0

    def test_the_password_to_watch_buys_no_guesses_at_the_one_to_drive(self, clock):
        throttle, guesses = Throttle(clock), 0
        for _ in range(100):
            guesses += throttle.wait("10.0.0.1") == 0.0
            if throttle.wait("10.0.0.1") == 0.0:
                throttle.forgive("10.0.0.1", wholly=False)
        assert guesses <= FREE_TRIES

    def test_one_network_of_ipv6_is_one_guesser(self, clock):
        throttle = Throttle(clock)
        for k in range(FREE_TRIES):
            throttle.wait(f"2001:db8::{k:x}")
        assert throttle.wait("2001:db8::ffff%eth0") > 0.0
        assert throttle.wait("2001:db8:0:1::1") == 0.0

    def test_an_address_is_itself_in_either_form(self, clock):
        throttle = Throttle(clock)
        for _ in range(FREE_TRIES):
            throttle.wait("::ffff:10.0.0.1")
        assert throttle.wait("10.0.0.1") > 0.0

    def test_addresses_are_forgotten_so_that_memory_is_bounded(self, clock, monkeypatch):
        monkeypatch.setattr("impslam.platform.console.throttle.MAX_ADDRESSES", 10)
        throttle = Throttle(clock)
        for k in range(100):
            clock.moment += 60.0
            throttle.wait(f"10.0.0.{k}")
        assert len(throttle._tries) == 10

    def test_a_bucket_returns_the_wait(self, clock):
        bucket = Bucket(2, 4.0, clock)
        assert [bucket.wait(), bucket.wait(), bucket.wait()] == [0.0, 0.0, 0.25]
        clock.moment += 0.25
        assert bucket.wait() == 0.0


class TestRefusals:
    def messages(self, caplog):
        return [record.getMessage() for record in caplog.records]

    def test_the_first_at_once_the_rest_as_a_count(self, clock, caplog):
        refusals = Refusals(clock)
        for k in range(1000):
            refusals.record("10.0.0.1", "login", f"try {k}")
        assert len(caplog.records) == FIRST
        assert self.messages(caplog)[0] == "refused 10.0.0.1: login (try 0)"
        clock.moment += WINDOW
        refusals.flush()
        assert self.messages(caplog)[-1] == "refused 10.0.0.1: login: 995 more in 60 s"
        refusals.record("10.0.0.1", "login")
        assert self.messages(caplog)[-1] == "refused 10.0.0.1: login"

    def test_kinds_and_addresses_are_counted_apart(self, clock, caplog):
        refusals = Refusals(clock)
        for _ in range(100):
            refusals.record("10.0.0.1", "login")
        refusals.record("10.0.0.1", "a foreign host")
        refusals.record("10.0.0.2", "login")
        assert len(caplog.records) == FIRST + 2

    def test_nothing_is_logged_twice_or_lost_at_the_end(self, clock, caplog):
        refusals = Refusals(clock)
        for _ in range(FIRST + 1):
            refusals.record("10.0.0.1", "login")
        refusals.flush()
        assert len(caplog.records) == FIRST
        refusals.flush(everything=True)
        assert self.messages(caplog)[-1].endswith("1 more in 0 s")
        refusals.flush(everything=True)
        assert len(caplog.records) == FIRST + 1

    def test_counts_are_logged_at_the_end_and_nothing_after_it(self, clock, caplog):
        refusals = Refusals(clock)
        for _ in range(FIRST + 1):
            refusals.record("10.0.0.1", "login")
        refusals.close()
        assert self.messages(caplog)[-1].endswith("1 more in 0 s")
        refusals.record("10.0.0.1", "the rest after its session ended")
        refusals.close()
        assert len(caplog.records) == FIRST + 1

    def test_many_addresses_do_not_fill_the_log(self, clock, caplog):
        refusals = Refusals(clock)
        for k in range(100_000):
            refusals.record(f"10.{k >> 16}.{k >> 8 & 255}.{k & 255}", "login")
        assert len(caplog.records) == LINE_BURST
        refusals.flush(everything=True)
        assert len(caplog.records) == LINE_BURST + 1
        assert f"{100_000 - LINE_BURST} more" in self.messages(caplog)[-1]

    def test_one_line_a_second_whatever_comes(self, clock, caplog):
        caplog.set_level(logging.INFO)
        refusals = Refusals(clock)
        for k in range(60_000):
            clock.moment += 0.01
            refusals.record(f"10.0.{k % 9}.{k % 250}", f"kind {k % 31}")
            refusals.admit(f"10.0.{k % 9}.{k % 250}", "logs in as watcher")
            if k % 100 == 0:
                refusals.flush()
        assert len(caplog.records) <= LINE_BURST + 600
        assert len(refusals._counts) <= MAX_KINDS + 1

    @pytest.mark.parametrize(
        "text", ["a\nrefused 10.0.0.9: login", "\x1b[31m", "\u202e", "é" * 999]
    )
    def test_untrusted_text_cannot_forge_log_lines(self, text):
        assert sanitised(text).isascii()
        assert sanitised(text).isprintable()
        assert len(sanitised(text)) <= 120


@pytest.mark.anyio
class TestGate:
    @pytest.fixture
    def anyio_backend(self):
        return "asyncio"

    @pytest.fixture
    def authenticator(self, accounts, clock, caplog):
        caplog.set_level(logging.INFO)
        return Authenticator(accounts, secure=True, clock=clock)

    @pytest.fixture
    def shown(self):
        return []

    @pytest.fixture
    def linked(self, tmp_path, clock, shown):
        return Authenticator(
            Accounts(tmp_path / "none"), secure=False, show=shown.append, clock=clock
        )

    async def test_logins_are_told_and_passwords_never(self, authenticator, caplog):
        _, session = await authenticator.enter("10.0.0.1", WATCH)
        assert not session.may_drive
        with pytest.raises(LoginRefused, match="Wrong password"):
            await authenticator.enter("10.0.0.1", "guessed-password")
        assert "10.0.0.1 logs in as watcher (watcher 1, by a password)" in caplog.text
        assert "refused 10.0.0.1: login (a wrong password)" in caplog.text
        assert WATCH not in caplog.text
        assert "guessed" not in caplog.text

    async def test_who_waits_costs_no_hash_and_is_refused_with_the_right_one_too(
        self, authenticator, monkeypatch
    ):
        hashes = []
        real = authenticator.accounts.right
        monkeypatch.setattr(
            authenticator.accounts, "right", lambda password: hashes.append(1) or real(password)
        )
        for _ in range(100):
            with pytest.raises(LoginRefused):
                await authenticator.enter("10.0.0.1", "guessed-password")
        with pytest.raises(LoginRefused, match="Too many") as messages:
            await authenticator.enter("10.0.0.1", DRIVE)
        assert messages.value.wait > 0.0
        assert len(hashes) == FREE_TRIES
        assert (await authenticator.enter("10.0.0.2", DRIVE))[1].may_drive

    async def test_right_logins_keep_nobody_out(self, authenticator, monkeypatch, caplog):
        """Logins of watchers do not delay those of a driver from the same address."""
        hashes = []
        real = authenticator.accounts.right
        monkeypatch.setattr(
            authenticator.accounts, "right", lambda password: hashes.append(1) or real(password)
        )
        for _ in range(300):
            assert not (await authenticator.enter("10.0.0.1", WATCH))[1].may_drive
        assert len(hashes) == 1
        assert len(caplog.records) <= FIRST
        assert (await authenticator.enter("10.0.0.1", DRIVE))[1].may_drive
        assert (await authenticator.enter("10.0.0.2", DRIVE))[1].may_drive

    async def test_a_remembered_password_ends_with_the_file(self, authenticator):
        await authenticator.enter("10.0.0.1", WATCH)
        authenticator.accounts.set("watch", "another password")  # the gate has not swept yet
        with pytest.raises(LoginRefused, match="Wrong password"):
            await authenticator.enter("10.0.0.1", WATCH)

    async def test_a_new_password_ends_every_session(self, authenticator, caplog):
        token, session = await authenticator.enter("10.0.0.1", DRIVE)
        authenticator.sweep()
        assert session.alive()
        authenticator.accounts.set("watch", "another password")
        authenticator.sweep()
        assert not session.alive()
        assert authenticator.sessions.find(token) is None
        assert "passwords have changed" in caplog.text

    async def test_a_file_that_others_can_read_lets_nobody_in(self, authenticator, caplog):
        authenticator.accounts.path.chmod(0o644)
        with pytest.raises(LoginRefused, match="its log says why"):
            await authenticator.enter("10.0.0.1", DRIVE)
        assert "chmod 600" in caplog.text
        assert not authenticator.open_by_link()

    def test_a_link_is_valid_once(self, linked, shown):
        linked.offer_link()
        token = shown[0].partition("token=")[2]
        with pytest.raises(LoginRefused):
            linked.redeem("127.0.0.1", token[:-1])
        _, session = linked.redeem("127.0.0.1", token)
        assert session.may_drive
        with pytest.raises(LoginRefused, match="used before"):
            linked.redeem("127.0.0.1", token)

    def test_a_link_is_valid_for_ten_minutes_and_then_replaced(self, linked, shown, clock):
        linked.offer_link()
        linked.offer_link()
        assert len(shown) == 1
        clock.moment += LINK_LIFETIME
        with pytest.raises(LoginRefused):
            linked.redeem("127.0.0.1", shown[0].partition("token=")[2])
        linked.offer_link()
        assert len(shown) == 2
        linked.redeem("127.0.0.1", shown[1].partition("token=")[2])
        clock.moment += 10.0
        assert linked.offer_link() == LINK_INTERVAL - 10.0  # one a minute
        assert len(shown) == 2
        clock.moment += LINK_INTERVAL
        assert linked.offer_link() == 0.0
        assert len(shown) == 3

    def test_a_link_ends_when_a_password_is_set(self, linked, shown):
        linked.offer_link()
        linked.accounts.set("drive", DRIVE)
        with pytest.raises(LoginRefused):
            linked.redeem("127.0.0.1", shown[0].partition("token=")[2])

    def basic(self, user, password):
        return "Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()

    async def test_a_script_has_user_and_password_and_costs_one_hash(
        self, authenticator, clock, monkeypatch
    ):
        hashes = []
        real = authenticator.accounts.right
        monkeypatch.setattr(
            authenticator.accounts, "right", lambda password: hashes.append(1) or real(password)
        )
        for _ in range(10):
            session = await authenticator.basic("10.0.0.1", self.basic("drive", DRIVE))
            assert session is not None
            assert not session.may_drive  # it fetches, nothing else
        assert len(hashes) == 1
        clock.moment += CACHE_LIFETIME
        await authenticator.basic("10.0.0.1", self.basic("drive", DRIVE))
        assert len(hashes) == 2
        authenticator.accounts.set("drive", "another password")
        authenticator.sweep()
        assert await authenticator.basic("10.0.0.1", self.basic("drive", DRIVE)) is None

    @pytest.mark.parametrize(
        "header",
        ["Basic", "Basic !", "Basic AAAA", "Bearer x", "Basic " + "/" * 4000, "Basic w4M6", ""],
    )
    async def test_odd_headers_let_nobody_in(self, authenticator, header):
        assert await authenticator.basic("10.0.0.1", header) is None

    async def test_the_user_is_the_right(self, authenticator):
        assert await authenticator.basic("10.0.0.1", self.basic("watch", DRIVE)) is None
        assert await authenticator.basic("10.0.0.1", self.basic("watch", WATCH)) is not None

    async def test_scripts_are_throttled_as_logins_are(self, authenticator):
        for k in range(FREE_TRIES):
            await authenticator.basic("10.0.0.1", self.basic("drive", f"guess-{k}"))
        assert await authenticator.basic("10.0.0.1", self.basic("drive", DRIVE)) is None
        with pytest.raises(LoginRefused, match="Too many"):
            await authenticator.enter("10.0.0.1", DRIVE)
