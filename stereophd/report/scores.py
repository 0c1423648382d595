"""Scores of tracks as a table for readers: rounded, with units and notes."""

from collections.abc import Iterator, Mapping
from typing import Any

from stereophd.report.tables import SummaryTable, table_text
from stereophd.wording import counted

# One row: name, value, and a note (may be empty).
Row = tuple[str, str, str]


def scores_text(report: Mapping[str, Any]) -> str:
    """Return the report of `stereophd.commands.evaluate.evaluate` as text for a terminal."""
    unit = f" {report['length_unit']}" if report["length_unit"] else ""
    sections = (_distance_rows, _error_rows, _number_rows, _identity_rows, _confirmation_rows, _scan_rows)
    rows = tuple(row for section in sections for row in section(report, unit))
    return table_text(SummaryTable("", (), rows, words=(0, 2)))


def _distance_rows(report: Mapping[str, Any], unit: str) -> Iterator[Row]:
    ospa, ospa2, gospa = report["ospa"], report["ospa2"], report["gospa"]
    unit = unit if ospa["base"] == "euclidean" else ""
    kind = f"p {ospa['order']:g}, c {ospa['cutoff']:g}{unit}, {ospa['base']}"
    yield "OSPA", _number(ospa["mean"], unit), f"mean over scans; {kind}"
    yield "  localisation", _number(ospa["localisation"], unit), ""
    yield "  cardinality", _number(ospa["cardinality"], unit), ""
    windows = f"of tracks, mean over windows of {ospa2['window_scans']} scans"
    yield "OSPA(2)", _number(ospa2["mean"], unit), windows
    yield "GOSPA", _number(gospa["mean"], unit), "mean over scans; alpha 2"
    if "tgospa" in report:
        tgospa = report["tgospa"]
        yield "trajectory GOSPA", _number(tgospa["mean"], unit), f"per scan; {tgospa['switches']:.3g} switches"


def _error_rows(report: Mapping[str, Any], unit: str) -> Iterator[Row]:
    rmse, error, nees = report["rmse"], report["position_error"], report["nees"]
    yield "RMSE position", _number(rmse["position"], unit), f"{error['n']} matched pairs"
    yield "RMSE velocity", _number(rmse["velocity"], f"{unit}/s" if unit else ""), ""
    yield "position error, median", _number(error["median"], unit), ""
    yield "position error, 90 %", _number(error["p90"], unit), ""
    low, high = nees["interval_95"]
    note = "" if report["plane"] is None else "not defined on a plane"
    if low is not None:
        note = f"{nees['dimension']} if consistent; 95 % between {low:.4g} and {high:.4g}"
        if nees["position"] is not None and not low <= nees["position"] <= high:
            ratio = (nees["position"] / nees["dimension"]) ** 0.5
            note += f": errors are {ratio:.3g} times what the tracks state"
            note += "; check noise, motion and cameras" if ratio > 1.0 else ""
    yield "NEES position", _number(nees["position"]), note
    if "without_cameras" in nees:
        yield "NEES without cameras", _number(nees["without_cameras"]), "what uncertain cameras add left out"


def _number_rows(report: Mapping[str, Any], unit: str) -> Iterator[Row]:
    cardinality, pairs = report["cardinality"], report["pairs"]
    means = f"{_number(cardinality['mean_estimates'])} for {_number(cardinality['mean_truth'])} on average"
    yield "cardinality bias", _number(cardinality["bias"]), means
    yield "cardinality MAE", _number(cardinality["mae"]), ""
    yield "missed / false", f"{pairs['missed']} / {pairs['false']}", "objects / estimates without a match"


def _identity_rows(report: Mapping[str, Any], unit: str) -> Iterator[Row]:
    switches, purity, completeness = (report[key] for key in ("identity_switches", "purity", "completeness"))
    clear = report["clear_mot"]
    if clear["mota"] is not None:
        parts = f"{clear['mostly_tracked']} objects mostly tracked, {clear['mostly_lost']} mostly lost"
        yield "MOTA", _number(clear["mota"]), parts
    note = "the tracks carry no identities" if switches is None else f"{report['tracks']} tracks"
    yield "identity switches", _number(switches), note
    parts = f"precision {_number(report['id_precision'])}, recall {_number(report['id_recall'])}"
    yield "IDF1", _number(report["idf1"]), parts
    hota = report["hota"]
    parts = f"detection {_number(hota['detection'])}, association {_number(hota['association'])}"
    yield "HOTA", _number(hota["mean"]), parts
    yield "track purity", _number(purity["mean"]), "mean share of estimates on one object"
    dominant = f"mean share of scans; by one track {_number(completeness['mean_dominant'])}"
    yield "object completeness", _number(completeness["mean"]), dominant
    yield "fragmentation", _number(completeness["fragmentation"]), "mean number of tracks on an object"


def _confirmation_rows(report: Mapping[str, Any], unit: str) -> Iterator[Row]:
    waited = report["confirmation"]
    note = f"mean over {counted(waited['objects'], 'object')}; median {_number(waited['median_s'], ' s')}"
    never = f", {waited['never']} never" if waited["never"] else ""
    yield "time to confirmation", _number(waited["mean_s"], " s"), f"{note}{never}"
    yield "  first report", _number(waited["first_report_mean_s"], " s"), "confirmed or tentative"


def _scan_rows(report: Mapping[str, Any], unit: str) -> Iterator[Row]:
    scans, window = report["scans"], report["window"]
    per = "time" if window["at"] == "times" else "event"
    span = [
        f", {word} {window[key]:g} s" for word, key in (("from", "from_s"), ("to", "to_s")) if window[key] is not None
    ]
    yield "scans scored", str(scans["scored"]), f"one for each {per}{''.join(span)}"
    reasons = {
        "outside_truth": "outside the truth",
        "truth_gap": "in a gap of the truth",
        "unseen": "nothing seen by enough cameras",
    }
    why = ", ".join(f"{scans[key]} {text}" for key, text in reasons.items() if scans[key])
    yield "  not scored", str(scans["not_scored"]), why
    if (found := report["alignment"]["found"]) is not None:
        clock = found["clock"]
        turn = sum(angle * angle for angle in found["rotation_deg"]) ** 0.5
        yield "  tracks aligned", report["alignment"]["frame"], f"turned by {turn:.4g} deg, scale {found['scale']:.6g}"
        if report["alignment"]["clock"]:
            yield "  clock aligned", _number(clock["shift_s"], " s"), f"rate {clock['rate']:.7g}"
    if report["tentative"]:
        yield "  tentative estimates", "", "scored together with the confirmed ones"
    if report["seen_by"] is not None:
        seen = report["seen_by"]
        yield "  only objects", "", f"seen by {seen['cameras']} cameras within {seen['within_s']:g} s"


def _number(value: float | None, unit: str = "") -> str:
    """Return a number with its unit, a dash where there is none."""
    if value is None:
        return "-"
    return f"{value}{unit}" if isinstance(value, int) else f"{value:.4g}{unit}"
