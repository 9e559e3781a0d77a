"""Run a Jupyter notebook without Jupyter: `python -m tests.docs.notebook` renews docs/notebook.ipynb."""

import ast
import base64
import contextlib
import io
import json
import os
import tempfile
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt

NOTEBOOK = Path(__file__).parents[2] / "docs" / "notebook.ipynb"
SIZE = 80  # dots per inch of a picture


def execute(book):
    """Return a notebook with the outputs of its cells, run in order in the current folder."""
    names = {"__name__": "__main__"}
    cells = [_run(cell, names) for cell in book["cells"]]
    return {**book, "cells": cells}


def _run(cell, names):
    if cell["cell_type"] != "code":
        return cell
    tree = ast.parse("".join(cell["source"]))
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(tree, "<cell>", "exec"), names)
        value = (
            None
            if last is None
            else eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)
        )
    outputs = []
    if printed.getvalue():
        outputs.append(
            {"name": "stdout", "output_type": "stream", "text": _lines(printed.getvalue())}
        )
    if value is not None:
        outputs.append(_result({"text/plain": _lines(repr(value))}))
    return {**cell, "outputs": [*outputs, *map(_result, _pictures())]}


def _lines(text):
    return text.splitlines(keepends=True)


def _result(data):
    return {"data": data, "metadata": {}, "output_type": "display_data"}


def _pictures():
    for number in plt.get_fignums():
        file = io.BytesIO()
        plt.figure(number).savefig(file, dpi=SIZE, bbox_inches="tight")
        plt.close(number)
        yield {"image/png": base64.b64encode(file.getvalue()).decode()}


if __name__ == "__main__":
    mpl.use("Agg")
    book = json.loads(NOTEBOOK.read_text("utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        book = execute(book)
    NOTEBOOK.write_text(json.dumps(book, indent=1, ensure_ascii=False) + "\n", "utf-8")
