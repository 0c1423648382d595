"""The documents: pages in the navigation, links, addresses, command lines and keys that exist."""

from __future__ import annotations

import importlib.util
import posixpath
import re
import shlex
import sys
import tomllib
import types
from pathlib import Path
from typing import Any

import pytest
import yaml

from stereophd.cli.app import command_line
from stereophd.site import SITE

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in DOCS.rglob("*.md"))
OUTSIDE = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md"]
# Diaries and decisions tell of the program of their day.
OF_THE_PRESENT = [name for name in PAGES + OUTSIDE if not name.startswith("docs/dev/")]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def without_code(name: str) -> str:
    return re.sub(r"^```.*?^```", "", text(name), flags=re.MULTILINE | re.DOTALL)


def anchors(name: str) -> set[str]:
    """Return the anchors of a page's headings, as the site and hosts of repositories make them."""
    found = set()
    for title in re.findall(r"^#+ +(.+)$", without_code(name), re.MULTILINE):
        words = re.sub(r"[^\w\- ]", "", title.replace("`", "").lower())
        found.add(words.strip().replace(" ", "-"))
    return found


def test_links_lead_somewhere() -> None:
    links = [(name, link) for name in PAGES + OUTSIDE for link in LINK.findall(without_code(name)) if "://" not in link]
    broken = []
    for name, link in links:
        path, _, anchor = link.partition("#")
        target = posixpath.normpath(posixpath.join(posixpath.dirname(name), path)) if path else name
        if not (ROOT / target).exists() or (anchor and target.endswith(".md") and anchor not in anchors(target)):
            broken.append((name, link))
    assert len(links) > 300
    assert broken == []


def test_every_page_is_in_the_navigation() -> None:
    listed = set(re.findall(r"[\w/*]+\.md", text("mkdocs.yml").split("nav:\n")[1]))
    folders = {name.removesuffix("*.md") for name in listed if name.endswith("*.md")}
    pages = {name.removeprefix("docs/") for name in PAGES if not name.startswith(("docs/dev/", "docs/decisions.md"))}
    assert {page for page in pages if page not in listed and not page.startswith(tuple(folders))} == set()


def test_addresses_are_one() -> None:
    site = re.search(r"^site_url: (\S+)$", text("mkdocs.yml"), re.MULTILINE)
    assert site is not None
    assert site[1] == SITE
    assert tomllib.loads(text("pyproject.toml"))["project"]["urls"]["Documentation"] == SITE
    assert f"url: {SITE}" in text("CITATION.cff")
    assert f"home: {SITE}" in text("recipe/meta.yaml")


def script(name: str) -> Any:
    """Return a script of the documents as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_measured_number_has_one_home() -> None:
    numbers = script("list_numbers")
    measured = {number for number in numbers.twice() if "." in number}
    assert measured == set(numbers.REVIEWED)


def test_the_readme_of_the_index_has_addresses_that_the_site_has(monkeypatch: pytest.MonkeyPatch) -> None:
    interface = types.SimpleNamespace(MetadataHookInterface=object)  # hatchling is there only while it builds
    monkeypatch.setitem(sys.modules, "hatchling.metadata.plugin.interface", interface)
    shown = script("index_readme").with_addresses(text("README.md"), SITE, "SOURCE")
    addresses = LINK.findall(shown)
    assert [address for address in addresses if not address.startswith((SITE, "SOURCE/blob/main/"))] == []
    assert f"{SITE}figures/demo.gif" in addresses
    for address in addresses:
        place = address.split("#")[0].removeprefix(SITE).rstrip("/")
        found = [DOCS / place, DOCS / f"{place}.md", DOCS / place / "index.md"]
        assert address.startswith("SOURCE") or any(path.exists() for path in found), address


def test_pages_that_messages_name_exist() -> None:
    named = set()
    for path in (ROOT / "stereophd").rglob("*.py"):
        named |= set(re.findall(r"\bpage\(['\"]([\w/]+)['\"]\)", path.read_text(encoding="utf-8")))
    assert named
    assert {
        name for name in named if not any((DOCS / f"{name}{end}").exists() for end in (".md", "/index.md"))
    } == set()


def test_the_version_of_the_citation_and_the_recipe_is_that_of_the_package() -> None:
    import stereophd

    assert yaml.safe_load(text("CITATION.cff"))["version"] == stereophd.__version__
    assert f'{{% set version = "{stereophd.__version__}" %}}' in text("recipe/meta.yaml")
    wanted = {line.replace(" ", "") for line in tomllib.loads(text("pyproject.toml"))["project"]["dependencies"]}
    listed = {line.strip(" -").replace(" ", "") for line in text("recipe/meta.yaml").splitlines()}
    assert {line.lower() for line in wanted} <= {line.lower() for line in listed}


def command_lines() -> list[tuple[str, str]]:
    """Return the lines with `stereophd` in the documents' shell blocks and configurations, continued lines joined."""
    found = []
    for path in sorted((ROOT / "configs").rglob("*.yaml")):
        comments = re.sub(r"\\\n#\s*", " ", path.read_text(encoding="utf-8"))
        found += [(path.name, line) for line in re.findall(r"^# +(stereophd .*)$", comments, re.MULTILINE)]
        assert re.findall(r"^#  +--.*$", comments, re.MULTILINE) == [], f"{path.name}: a line is not continued"
    for name in OF_THE_PRESENT:
        for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text(name), re.MULTILINE | re.DOTALL):
            if language not in ("sh", "bash", "yaml", ""):
                continue
            for line in re.sub(r"\\\n\s*", " ", block).splitlines():
                match = re.match(r"^(?:\$ |- run: )?(stereophd .*)$", line.strip())
                if match:
                    found.append((name, match[1].split("   #")[0]))
    return found


@pytest.mark.parametrize(("name", "line"), command_lines())
def test_command_lines_use_options_that_exist(name: str, line: str) -> None:
    words = shlex.split(line.replace("...", "x"), comments=True)[1:]
    command = command_line()
    while words and hasattr(command, "commands") and not words[0].startswith("-"):
        command = command.commands[words.pop(0)]
    options = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    options |= {"--help", "-h", "--install-completion", "--show-completion"}
    assert {word.split("=")[0] for word in words if re.match(r"^--?[a-z]", word)} <= options


def test_every_benchmark_is_listed() -> None:
    scripts = {path.name for path in (ROOT / "benchmarks").glob("*.py")}
    assert set(re.findall(r"^\| `(\w+\.py)`", text("benchmarks/README.md"), re.MULTILINE)) == scripts


@pytest.mark.parametrize("name", OF_THE_PRESENT)
def test_pages_for_readers_are_not_diaries(name: str) -> None:
    """No dates of measurements, loads of machines or versions of the code: that is what docs/dev is for."""
    diary = re.compile(r"\b2026-\d\d-\d\d\b|present code|earlier code|busy machine|\bat load \d|processor time")
    assert [line for line in text(name).splitlines() if diary.search(line)] == []


def test_the_tables_of_results_are_those_that_the_script_writes() -> None:
    marks = [mark for name in PAGES for mark in re.findall(r"<!-- results (\w+) -->", text(name))]
    made = re.search(r"^TABLES: .*?^}", text("docs/make_results.py"), re.MULTILINE | re.DOTALL)
    assert made is not None
    assert sorted(marks) == sorted(re.findall(r'^    "(\w+)":', made[0], re.MULTILINE))


def test_the_glossary_is_sorted_and_complete() -> None:
    terms = re.findall(r"^\*\*(.+?)\*\*", text("docs/reference/glossary.md"), re.MULTILINE)
    assert terms == sorted(terms, key=str.lower)
    assert len(terms) >= 60


def test_promises_are_the_words_of_the_pages_and_have_their_tests() -> None:
    measured = text("docs/dev/measured/reliability.md")
    pages = " ".join((text("docs/explanation/reliability.md") + text("docs/explanation/security.md")).split())
    promises = re.findall(r"^\| (.+?) \|", measured.partition("\n## What an attack found")[0], re.MULTILINE)[1:]
    assert len(promises) > 20
    assert [promise for promise in promises if promise not in pages] == []
    for name, function in re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", measured):
        assert f"def {function}(" in text(name), (name, function)
