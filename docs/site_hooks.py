"""What the site holds beside the pages of docs/: MathJax, the configurations, generated pages, and links to them.

MkDocs calls `on_config`, `on_files` and `on_page_markdown`. Files outside docs/ that pages link to (configurations, the
changelog) become files of the site, so that a link works both in the repository and in the site.
"""

from __future__ import annotations

import os
import posixpath
import re
import subprocess
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
# Pages that lie outside docs/, by their place in the site.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "about/contributing.md",
    "CHANGELOG.md": "about/changelog.md",
    "benchmarks/README.md": "about/benchmarks.md",
}
LINK = re.compile(r"(\]\()([^)\s#]+)([^)\s]*\))")


def on_config(config: Any) -> Any:
    """List the sections of the configuration in the navigation: one page each, in the order of the index."""
    folder = ROOT / "docs/reference/configuration"
    sections = re.findall(r"\((\w+)\.md\) \|", (folder / "index.md").read_text(encoding="utf-8"))
    pages = ["reference/configuration/index.md", *({name: f"reference/configuration/{name}.md"} for name in sections)]
    reference = next(part["Reference"] for part in config.nav if "Reference" in part)
    next(part for part in reference if "Configuration" in part)["Configuration"] = pages
    return config


def on_files(collection: Files, config: Any, **_: Any) -> Files:
    """Add the files that do not lie in docs/."""
    script = files("mathjax") / "static" / "mathjax" / "es5" / "tex-svg-full.js"
    collection.append(File.generated(config, "assets/tex-svg-full.js", content=script.read_bytes()))
    names = ("sample_data/hall.yaml", "LICENSE", "CITATION.cff")
    plain = [*ROOT.glob("configs/**/*.yaml"), *ROOT.glob("configs/*.json"), *(ROOT / name for name in names)]
    for path in sorted(plain):
        collection.append(File.generated(config, path.relative_to(ROOT).as_posix(), content=path.read_bytes()))
    for source, page in PAGES.items():
        collection.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    collection.append(File.generated(config, "reference/commands.md", content=commands_page()))
    return collection


def on_page_markdown(text: str, page: Any, files: Files, **_: Any) -> str:
    """Let links to files outside docs/ point to their places in the site."""
    place = page.file.src_uri
    source = next((name for name, shown in PAGES.items() if shown == place), f"docs/{place}")

    def rewritten(match: re.Match[str]) -> str:
        if ":" in match[2]:
            return match[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), match[2]))
        inside = PAGES.get(target, target.removeprefix("docs/"))
        if files.get_file_from_path(inside) is None:
            return match[0]
        return f"{match[1]}{posixpath.relpath(inside, posixpath.dirname(place) or '.')}{match[3]}"

    return LINK.sub(rewritten, text)


def commands_page() -> str:
    """Return the page of all commands, which is what `--help` prints."""
    from stereophd.cli.app import command_line

    names = [""]
    for name, command in command_line().commands.items():
        names += [f"{name} {part}" for part in getattr(command, "commands", [])] or [name]
    parts = ["# Commands\n\nEach section is what `stereophd COMMAND --help` prints.\n"]
    for name in names:
        words = [sys.executable, "-m", "stereophd", *name.split(), "--help"]
        result = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True, env=environment())
        parts.append(f"## `{f'stereophd {name}'.strip()}`\n\n```text\n{result.stdout.rstrip()}\n```\n")
    return "\n".join(parts)


def environment() -> dict[str, str]:
    """Return the environment of the help pages: a terminal of 100 columns."""
    return {**os.environ, "COLUMNS": "100", "NO_COLOR": "1"}
