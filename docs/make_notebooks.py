"""Run the notebooks of docs/notebooks, and write each as .ipynb and as a page of the site, with its outputs.

    python docs/make_notebooks.py

A notebook is a script of cells, marked `# %%` (code) and `# %% [markdown]`.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import html
import io
import json
import os
import tempfile
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent / "notebooks"


def cells(text: str) -> list[tuple[str, str]]:
    """Return (kind, source) of the cells of a script; kind is code or markdown."""
    parts = [part.partition("\n") for part in text.split("# %%")[1:]]
    found = []
    for head, _, body in parts:
        source = body.strip("\n")
        if "[markdown]" in head:
            source = "\n".join(line.removeprefix("#").removeprefix(" ") for line in source.splitlines())
        found.append(("markdown" if "[markdown]" in head else "code", source))
    return found


def run(source: str, names: dict[str, Any]) -> tuple[str, Any]:
    """Run a cell; return what it printed, and the value of its last line if that is an expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "cell", "exec"), names)
        value = None if last is None else eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    return printed.getvalue(), value


def shown(value: Any) -> tuple[str, bytes]:
    """Return the text and the picture of a value."""
    if hasattr(value, "savefig"):
        picture = io.BytesIO()
        value.savefig(picture, format="png", dpi=80, metadata={"Software": None})
        return "", picture.getvalue()
    if hasattr(value, "_repr_html_") and not hasattr(value, "to_string"):
        return html.unescape(value._repr_html_().removeprefix("<pre>").removesuffix("</pre>")), b""
    return "" if value is None else str(value), b""


def write(script: Path) -> None:
    """Run a script in an empty folder, and write the notebook and the page beside it."""
    names: dict[str, Any] = {}
    page, notebook = [], []
    for number, (kind, source) in enumerate(cells(script.read_text(encoding="utf-8"))):
        if kind == "markdown":
            page.append(source)
            notebook.append({"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": source})
            continue
        printed, value = run(source, names)
        text, picture = shown(value)
        page.append(f"```python\n{source}\n```")
        outputs: list[dict[str, Any]] = []
        if text or printed:
            page.append(f"```text\n{(printed + text).rstrip()}\n```")
            data = {"text/plain": (printed + text).rstrip()}
            outputs.append({"output_type": "execute_result", "execution_count": None, "metadata": {}, "data": data})
        if picture:
            name = f"{script.stem}_{number}.png"
            (script.parent / name).write_bytes(picture)
            page.append(f"![Output of the cell above]({name})")
            data = {"image/png": base64.b64encode(picture).decode()}
            outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
        cell = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": source}
        notebook.append({**cell, "execution_count": None, "outputs": outputs})
    note = f"[This page as a notebook]({script.stem}.ipynb). The tests run it."
    script.with_suffix(".md").write_text("\n\n".join([page[0], note, *page[1:]]) + "\n", encoding="utf-8")
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    document = {"cells": notebook, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}
    script.with_suffix(".ipynb").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Write all notebooks."""
    for script in sorted(FOLDER.glob("*.py")):
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            write(script)
        print(os.path.relpath(script.with_suffix(".md")))


if __name__ == "__main__":
    main()
