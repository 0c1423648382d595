"""Put the page together: tables as HTML, the data, the script and the style."""

import json
from base64 import b64encode
from collections.abc import Iterator, Sequence
from hashlib import sha256
from html import escape
from importlib.resources import files
from importlib.util import find_spec
from typing import Any, NamedTuple

import yaml

from stereophd.errors import InputError
from stereophd.io.documents import expecting
from stereophd.io.outputs.json_text import plain
from stereophd.pipeline.inspection.runs import Run
from stereophd.report.page.data import run_data
from stereophd.report.summaries import fit_totals, residual_text, run_tables, share, tracking_part, verdict
from stereophd.report.tables import CHECKS, SummaryTable
from stereophd.wording import number

# Tracks that the page lists, a page of the table at a time.
TRACKS_LISTED = 5000


def page(runs: Sequence[Run], title: str = "stereophd report") -> str:
    """Return the HTML of a page about some runs, or raise InputError when plotly is not installed."""
    if find_spec("plotly") is None:
        raise InputError("the page needs plotly, which is not installed: pip install plotly")
    from plotly.offline import get_plotlyjs

    shown = [_shown(run, number, len(runs)) for number, run in enumerate(runs)]
    data = {"runs": [one.data for one in shown]}
    parts = {
        "TITLE": escape(title),
        "VERDICTS": "\n".join(one.verdict for one in shown),
        "COMPARISON": "" if len(runs) < 2 else _html(_comparison([run.name for run in runs], shown)),
        "DETAILS": "\n".join(one.details for one in shown),
        "STYLE": _resource("page.css"),
        # "</script" inside a text of the script would end the element
        "PLOTLY": get_plotlyjs().replace("</script", "<\\/script"),
        "DATA": json.dumps(plain(data), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "SCRIPT": _resource("page.js"),
    }
    parts["HASHES"] = " ".join(script_hash(f"\n{parts[name]}\n") for name in ("PLOTLY", "SCRIPT"))
    out = []
    for k, piece in enumerate(_resource("page.html").split("%%")):
        out.append(parts[piece] if k % 2 else piece)
    return "".join(out)


class _Shown(NamedTuple):
    data: dict[str, Any]  # For the script
    verdict: str
    details: str
    figures: dict[str, str | None]  # Beside those of other runs


def _shown(run: Run, index: int, runs: int) -> _Shown:
    """Return what the page shows of one of `runs` runs, or raise InputError where its reports are none of stereophd."""
    with expecting("a report of stereophd", ", ".join(map(str, run.files))):
        return _Shown(run_data(run, runs), _verdict(run), _details(run, index), dict(_figures(run)))


def script_hash(text: str) -> str:
    """Return the source expression of a content security policy that allows a script with exactly this text."""
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"


def _resource(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _verdict(run: Run) -> str:
    text = verdict(run.report, None if run.evaluation is None else run.evaluation.report)
    doubtful = any(finding["status"] == "warning" for finding in run.report.get("checks", ()))
    doubtful |= run.report.get("status") not in (None, "determined")
    doubtful |= run.command == "track" and not tracking_part(run.report).get("tracks")
    mark = "<span>Doubtful:</span> " if doubtful else "<span aria-hidden='true'>&#10003;</span> "
    return (
        f"<p class='verdict {'doubt' if doubtful else 'fine'}'><strong>{escape(run.name)}</strong> "
        f"<small>{escape(run.command)}</small><br>{mark}{escape(text)}</p>"
    )


def _comparison(names: Sequence[str], shown: Sequence[_Shown]) -> SummaryTable:
    """Return the figures of all runs side by side; rows that no run has are left out."""
    columns = [one.figures for one in shown]
    rows = [
        (name, *(column[name] or "-" for column in columns))
        for name in columns[0]
        if any(column[name] is not None for column in columns)
    ]
    return SummaryTable("Summary", ("", *names), tuple(rows))


def _figures(run: Run) -> Iterator[tuple[str, str | None]]:
    tracking = tracking_part(run.report)
    config, unit = run.provenance["config"], run.length_unit
    score = None if run.evaluation is None else run.evaluation.report
    totals = fit_totals(tracking)
    yield "command", run.command
    yield "seed", None if run.provenance["seed"] is None else str(run.provenance["seed"])
    yield "filter", (config.get("filter") or {}).get("kind")
    yield "tracks", str(len(tracking["tracks"])) if "tracks" in tracking else None
    yield "estimates", str(tracking["estimates"]) if "estimates" in tracking else None
    yield "detections", str(totals.detections) if tracking.get("cameras") else None
    yield "explained", None if totals.explained is None else share(totals.explained)
    known = totals.residual_px is not None
    yield "residual", residual_text(totals.residual_px, totals.outliers, " px") if known else None
    yield "log-likelihood", f"{tracking['log_likelihood']:.1f}" if "log_likelihood" in tracking else None
    checks = run.report.get("checks")
    yield "warnings", None if checks is None else str(sum(check["status"] == "warning" for check in checks))
    yield "OSPA", f"{number(score['ospa']['mean'])} {unit}" if score else None
    yield "GOSPA", f"{number(score['gospa'].get('mean'))} {unit}" if score else None
    yield "position error, RMSE", f"{number(score['rmse'].get('position'))} {unit}" if score else None
    switches, nees = (score["identity_switches"], score["nees"]) if score else (None, {})
    yield "identity switches", None if switches is None else str(switches)
    expected = f" ({nees.get('dimension')} is right)"
    known = nees.get("position") is not None
    yield "consistency (NEES of position)", number(nees["position"]) + expected if known else None
    yield "NEES without uncertain cameras", number(nees["without_cameras"]) if "without_cameras" in nees else None
    part = tracking.get("cameras_part")
    moves = f"{number(part.get('common_std'))}, {number(part.get('other_std'))} {unit}" if part else None
    yield "uncertain cameras: common move, other move", moves


def _details(run: Run, index: int) -> str:
    """Tables, configuration and origin of a run; the script shows those of the chosen one."""
    tables = "\n".join(_html(table) for table in run_tables(run.report, TRACKS_LISTED))
    record = run.provenance
    settings = yaml.safe_dump(plain(record["config"]), sort_keys=False, default_flow_style=None, width=110)
    origin = [
        ("made by", f"stereophd {record.get('version')} {record.get('command')}"),
        ("seed", str(record.get("seed"))),
        ("configuration, resolved, SHA-256", str(record.get("config_sha256"))),
        *((f"input file, {role}, SHA-256", digest) for role, digest in record["inputs"].items()),
    ]
    return (
        f"<div class='details' data-run='{index}'><h3>{escape(run.name)}</h3>{tables}"
        + _html(SummaryTable("Origin", ("", ""), tuple(origin)))
        + f"<details><summary>Configuration</summary><pre>{escape(settings)}</pre></details></div>"
    )


def _html(table: SummaryTable) -> str:
    head = "".join(f"<th scope='col'>{escape(cell)}</th>" for cell in table.header)
    rows = "".join(
        "<tr>" + "".join(f"<{_tag(k)}>{escape(cell)}</{_tag(k)[:2]}>" for k, cell in enumerate(row)) + "</tr>"
        for row in table.rows
    )
    body = f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>" if rows else ""
    notes = "".join(f"<p class='note'>{escape(note)}</p>" for note in table.notes)
    kind = " words" if table.title == CHECKS else ""
    return f"<section class='table{kind}'><h4>{escape(table.title)}</h4><div class='wide'>{body}</div>{notes}</section>"


def _tag(column: int) -> str:
    return "th scope='row'" if column == 0 else "td"
