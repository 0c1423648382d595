"""Measure the tables of docs/results anew, and write them into the pages between their marks: `make results`.

    python docs/make_results.py            # all, in about 15 minutes of CPU time
    python docs/make_results.py figure10   # some
    python docs/make_results.py --runs 3   # few runs of each, to try it

A table lies between `<!-- results NAME -->` and `<!-- end -->`, so that each number has one home, which a repository
shows as the site does. Experiments are those of configs/paper, with their seeds; the rest are scripts of benchmarks.
Outputs are kept in out/results, and an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import stereophd

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted((ROOT / "docs" / "results").glob("*.md"))
MARK = re.compile(r"(<!-- results (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
OUT = ROOT / "out" / "results"
# Runs of experiments whose configuration has more than a table needs, or fewer (the paper's 50 of Table II).
RUNS = {"table2_long": 500, "static_scene": 10}
Rows = Iterator[list[str]]


class Experiment:
    """The summary of an experiment: values by method, quantity and case."""

    def __init__(self, config: str, runs: int | None, out: str | None = None) -> None:
        path, folder = ROOT / "configs" / "paper" / f"{config}.yaml", OUT / (out or config)
        runs = runs or RUNS.get(out or config)
        changes = [] if runs is None else [f"experiment.runs={runs}"]
        stereophd.experiment(path, out=folder, overrides=changes, force=True, resume=True)
        found = stereophd.Outputs(folder, {})
        rows = found.table("summary").to_pylist()
        self.rows = {(row["method"], row["quantity"], row["case"]): row for row in rows if row["time_s"] is None}
        self.runs = max(row["runs"] for row in rows)
        self.ratios = json.loads((folder / "timing.json").read_text(encoding="utf-8"))["ratio_to_first_method"]

    def get(self, method: str, quantity: str, case: str = "all", key: str = "mean") -> float:
        """Return a value of a row; NaN where it is not defined."""
        value = self.rows[method, quantity, case][key]
        return math.nan if value is None else float(value)


def number(value: float, digits: int = 3) -> str:
    """Return a number with some significant digits, never in powers of ten."""
    if not math.isfinite(value):
        return ""
    if value == 0.0:
        return "0"
    places = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{places}f}"


def interval(found: Experiment, method: str, quantity: str, case: str = "all", digits: int = 3) -> str:
    """Return a mean with its 95 % interval."""
    low, high = (found.get(method, quantity, case, key) for key in ("ci_low", "ci_high"))
    mean = number(found.get(method, quantity, case), digits)
    same = not math.isfinite(low) or number(low, digits) == number(high, digits)
    return mean if same else f"{mean} [{number(low, digits)}, {number(high, digits)}]"


def over(found: Experiment, method: str, quantity: str, case: str = "all") -> str:
    """Return a value, in brackets over its bound."""
    value, bound = found.get(method, quantity, case), found.get(method, quantity, case, "bound")
    return f"{number(value)} ({number(value / bound, 2 if value > 1.95 * bound else 3)})"


def table(header: str, rows: Rows) -> str:
    """Return a Markdown table; the header is that of its columns, between bars."""
    cells = header.split("|")
    lines = [f"| {' | '.join(cell.strip() for cell in cells)} |", f"|{'---|' * len(cells)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def table2(runs: int | None) -> str:
    """Table II: a row for each distance and method, a column for each prior."""
    short, long = Experiment("table2", runs), Experiment("table2", runs, "table2_long")
    paper = {
        ("disparity space", 50): ["1.11 (4.30)", "0.462 (0.291)", "0.552 (0.544)"],
        ("disparity space", 100): ["0.845 (0.630)", "0.998 (0.667)", "1.23 (1.09)"],
        ("disparity space", 150): ["1.80 (1.63)", "1.88 (1.48)", "1.78 (1.35)"],
        ("particle filter, linear", 50): ["156 (250)", "94.5 (62.8)", "62.9 (52.0)"],
        ("particle filter, linear", 100): ["1.30 (0.98)", "1.11 (0.686)", "1.03 (0.669)"],
        ("particle filter, linear", 150): ["2.35 (1.69)", "2.81 (1.95)", "2.23 (1.92)"],
    }
    labels = {
        "disparity space": "disparity space",
        "disparity space, QMC": "64 low-discrepancy samples",
        "particle filter, linear": "particle filter, linear weights",
        "particle filter, logarithmic": "particle filter, logarithmic weights",
        "inverse-depth EKF": "inverse-depth EKF",
    }
    quantity = "final_position_error"

    def rows() -> Rows:
        for place in (50, 100, 150):
            cases = [f"object at {place} cm, prior {prior}" for prior in ("6 (4)", "7 (5.4)", "8 (7.1)")]
            bound = number(short.get("disparity space", quantity, cases[1], "bound"))
            head = f"{place} cm, bound {bound}"
            for method, label in labels.items():
                for found in (short, long) if (method, place) in paper else (long,):
                    cells = [
                        f"{number(found.get(method, quantity, case))} "
                        f"({number(found.get(method, quantity, case, 'std'))})"
                        for case in cases
                    ]
                    ratios = [found.get(method, quantity, c) / found.get(method, quantity, c, "bound") for c in cases]
                    shown = ", ".join(number(ratio, 3 if ratio > 1 else 2) for ratio in ratios)
                    yield [head, f"{label}, {found.runs} runs", *cells, shown]
                    head = ""
                if (method, place) in paper:
                    yield ["", "*paper*", *(f"*{cell}*" for cell in paper[method, place]), ""]

    return table("object at | | prior 6 (4) | prior 7 (5.4) | prior 8 (7.1) | mean over the bound", rows())


def move(config: str, runs: int | None) -> str:
    """Figures 4 and 7: how the moments of a moved Gaussian differ from those of a million samples."""
    found = Experiment(config, runs)
    labels = {
        "64 QMC": "64 low-discrepancy samples",
        "512 QMC": "512 low-discrepancy samples",
        "adaptive": "adaptive, 64",
    }

    def rows() -> Rows:
        for method in dict.fromkeys(method for method, *_ in found.rows):
            means, stds = [], []
            for axis in "uvd":
                variance, true = (found.get(method, f"covariance_{axis}{axis}", key=key) for key in ("mean", "bound"))
                shift = found.get(method, f"mean_{axis}") - found.get(method, f"mean_{axis}", key="bound")
                means.append(f"{shift / math.sqrt(true):.3f}".replace("-0.000", "0.000"))
                stds.append(f"{math.sqrt(variance / true):.3f}")
            divergence = interval(found, method, "divergence", digits=2)
            yield [labels.get(method, method), divergence, ", ".join(means), ", ".join(stds)]

    return table("method | divergence, nat | mean | standard deviation", rows())


def figure10(runs: int | None) -> str:
    """A static object: errors over the bound."""
    found = Experiment("figure10", runs)
    labels = {
        "disparity space": "disparity space, 100 samples",
        "disparity space, QMC": "disparity space, 64 low-discrepancy samples",
    }

    def rows() -> Rows:
        second, last = "position_rmse_second", "position_rmse_last_ten"
        bounds = [number(found.get("disparity space", quantity, key="bound")) for quantity in (second, last)]
        yield ["bound", *bounds, ""]
        for method in dict.fromkeys(method for method, *_ in found.rows):
            nees = number(found.get(method, "position_nees_last_ten"), 2)
            yield [labels.get(method, method), over(found, method, second), over(found, method, last), nees]

    return table("method | second observation | last ten | NEES, last ten", rows())


def figure11(runs: int | None) -> str:
    """An object that moves away: errors over the bound, lost runs, time."""
    found = Experiment("figure11", runs)
    windows = [
        "position_rmse_first_steps", "position_rmse_from_step_20", "position_rmse_last_steps",
        "velocity_rmse_from_step_20",
    ]  # fmt: skip

    def rows() -> Rows:
        yield ["bound", *(number(found.get("disparity space, 250", name, key="bound")) for name in windows), ""]
        methods = list(dict.fromkeys(method for method, *_ in found.rows))
        for method in sorted(methods, key=lambda name: not name.startswith("disparity")):
            label = method.replace(" QMC", " low-discrepancy samples")
            yield [label, *(over(found, method, name) for name in windows), number(found.ratios[method], 2)]

    header = (
        "method | position, first 20 steps, cm | from step 20 | last 50 steps | velocity, from step 20, cm/s | time"
    )
    return table(header, rows())


def figure12(runs: int | None) -> str:
    """Many objects: OSPA of the filters beside the limit, over all frames and over the second half."""
    found = Experiment("figure12", runs)
    kinds = ["p1_c10", "p1_c20", "p2_c10", "p2_c20", "mahalanobis_p2_c10"]
    parts = []
    for window, title in (("all", "all 100 s"), ("last_50", "last 50 s")):

        def rows(window: str = window) -> Rows:
            for method in dict.fromkeys(method for method, *_ in found.rows):
                cells = [
                    interval(found, method, f"ospa_{kind}_{window}") if kind == "p2_c20"
                    else number(found.get(method, f"ospa_{kind}_{window}"))
                    for kind in kinds
                ]  # fmt: skip
                yield [method, *cells]

        parts.append(table(f"{title} | p 1, c 10 | p 1, c 20 | p 2, c 10 | p 2, c 20 | Mahalanobis, p 2, c 10", rows()))
    return "\n\n".join(parts)


def static_scene(runs: int | None) -> str:
    """Feature correspondence: landmarks found and errors after the last view."""
    found = Experiment("static_scene", runs)

    def share(method: str, quantity: str, case: str) -> str:
        value = 100.0 * found.get(method, quantity, case)
        return f"{number(value, 3 if value > 10.0 else 2)} %"

    def rows() -> Rows:
        for case in dict.fromkeys(case for *_, case in found.rows):
            for method in ("GM-PHD", "PMB"):
                values = [
                    number(found.get(method, quantity, case), 2) for quantity in ("points_false", "position_error")
                ]
                yield [
                    case.removeprefix("views "), method, share(method, "points_found", case), *values,
                    interval(found, method, "error_over_bound", case), number(found.get(method, "nees", case), 2),
                    share(method, "correspondence_right", case), share(method, "correspondence_wrong", case),
                ]  # fmt: skip

    header = (
        "views | filter | points found | false points | error, cm | over the bound | NEES (3 is right) | detections "
        "that are right | of those given to a landmark, wrong"
    )
    return table(header, rows())


def benchmark(script: str, *words: str) -> Any:
    """Return the last JSON document that a script of benchmarks/ prints, whether or not targets were met."""
    command = [sys.executable, str(ROOT / "benchmarks" / script), *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    begins = [match.start() for match in re.finditer(r"^[{\[]", printed.stdout, re.MULTILINE)]
    for begin in begins:
        try:
            return json.loads(printed.stdout[begin:])
        except ValueError:
            continue
    raise SystemExit(f"{script}: expected a JSON document, found {printed.stdout}{printed.stderr}")


def peers(runs: int | None) -> str:
    """Stereophd beside two trackers built on Stone Soup, on the same scenes."""
    found = benchmark("peers.py", "--json", "--seeds", *map(str, range(1, 1 + (runs or 10))))
    labels = {
        "PMB (stereophd)": "stereophd, PMB",
        "Stone Soup, GNN and EKF": "Stone Soup, global nearest neighbours",
        "Stone Soup, GM-PHD and EKF": "Stone Soup, GM-PHD",
    }
    header = (
        "tracker | OSPA, second half: mean | median over scenes | OSPA, all frames | frames with a wrong number | "
        "CPU time, relative"
    )
    rows = (
        [
            label, number(found[name]["ospa_last_half"]), number(found[name]["ospa_last_half_median"]),
            number(found[name]["ospa"]), f"{number(100.0 * found[name]['wrong_number'], 2)} %",
            number(found[name].get("times_ours", 1.0), 2),
        ]
        for name, label in labels.items()
    )  # fmt: skip
    return table(header, rows)


def calibration(runs: int | None) -> str:
    """The paper's experiment of calibration over simulated scenes, each with its own guess."""

    def rows() -> Rows:
        for label, words in (
            ("the paper's priors (5 cm; 1, 7.5 and 1 degrees)", []),
            ("priors three times as wide", ["--prior-factor", "3"]),
        ):
            found = benchmark("calibration_monte_carlo.py", "--jobs", "1", "--runs", str(runs or 30), *words)
            rotation, direction = found["rotation_deg"], found["direction_deg"]
            yield [
                label, str(found["runs"]), str(found["within_5_bounds"]), f"{number(rotation['median'], 2)} deg",
                f"{number(rotation['over_bound_median'])}, {number(rotation['over_bound_most'])}",
                f"{number(direction['median'], 2)} deg",
                f"{number(direction['over_bound_median'])}, {number(direction['over_bound_most'])}",
                f"{number(100.0 * found['covered_90'], 2)} %", number(found["nees_mean"], 2),
            ]  # fmt: skip

    header = (
        "two cameras, six objects, clutter 10 | runs | `determined`, below 5 bounds | rotation: median | over the "
        "bound: median, largest | direction of translation: median | over the bound: median, largest | 90 % "
        "intervals that hold | NEES (1 is right)"
    )
    return table(header, rows())


def speed(runs: int | None) -> str:
    """CPU time per event of the filters, on one thread."""
    quick = [] if runs is None else ["--events", "60", "--repetitions", "1"]
    filters = benchmark("track_speed.py", "--json", *(quick or ["--repetitions", "5"]))
    many = benchmark("many_objects.py", "--json", "--objects", "25", "200", "--frames", "400", "--repetitions", "1")

    def rows() -> Rows:
        for found in filters:
            kind, many_components = found["filter"].split(",")[0], found["components_per_event"]
            yield [
                f"{kind}, six objects, {many_components:.0f} components of {found['samples']} samples",
                number(found["ms_per_event"]["filter"], 2), number(found["filter_over_floor"], 2),
                f"{number(found['numpy_over_filter'], 2)} times as long",
            ]  # fmt: skip
        for row in many["rows"]:
            yield [f"PMB, {row['objects']} objects, four cameras, clutter 50", number(row["ms_per_event"], 2), "", ""]

    return table("per event, one thread | ms | over the bare kernels | plain NumPy takes", rows())


TABLES: dict[str, Callable[[int | None], str]] = {
    "table2": table2,
    "figure4": lambda runs: move("figure4", runs),
    "figure7": lambda runs: move("figure7", runs),
    "figure10": figure10,
    "figure11": figure11,
    "figure12": figure12,
    "static_scene": static_scene,
    "peers": peers,
    "calibration": calibration,
    "speed": speed,
}


def put(name: str, text: str) -> None:
    """Write a table into the page that has its mark."""
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        after = MARK.sub(lambda match: f"{match[1]}{text}\n{match[3]}" if match[2] == name else match[0], before)
        if after != before:
            page.write_text(after, encoding="utf-8")


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=", ".join(TABLES))
    parser.add_argument("--runs", type=int, help="few runs of each, to try it: prints the tables")
    options = parser.parse_args()
    for name in options.tables or TABLES:
        text = TABLES[name](options.runs)
        print(f"{name}\n{text}\n", flush=True)
        if options.runs is None:
            put(name, text)


if __name__ == "__main__":
    main()
