"""A small run of every command that writes, for what disturbs them: faults, kills, double starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
QUICKSTART = CONFIGS / "quickstart.yaml"
CALIBRATION = CONFIGS / "paper" / "calibration.yaml"
EXPERIMENT = CONFIGS / "paper" / "figure4.yaml"


@dataclass(frozen=True)
class SmallRun:
    """Words of a command without its output, the name of that (a file where it has an ending), and `--resume`.

    `in_parts` states that each folder of the output comes into its place on its own, as that of each of several logs.
    """

    words: tuple[str, ...]
    out: str = "out"
    resumes: bool = False
    in_parts: bool = False

    def command(self, place: Path, *more: str) -> list[str]:
        """Return the words of a run whose output lies in `place`."""
        target = str(place / self.out)
        if self.words[0] == "init":
            return ["init", target, *self.words[1:], *more, "-q"]
        return [*self.words, "--out", target, *more, "-q"]

    def next_run(self, place: Path, over: bool = False) -> list[str]:
        """Return the words of the run after one that was disturbed: it continues what is kept, or replaces.

        `over` states that a finished run of another kind is in the way.
        """
        kept = self.resumes and any(next((place / self.out).glob(f"{above}partial-*"), None) for above in ("", "*/"))
        return self.command(place, *(["--resume"] if kept else []), *(["--force"] if over or not kept else []))


def is_as_before(
    found: Mapping[str, bytes], earlier: Mapping[str, bytes], whole: Mapping[str, bytes], parts: bool
) -> bool:
    """Whether what a failed run left is the earlier output; in `parts`, each folder may be the earlier or the new one.

    The summary of several logs, which states what failed, is not compared.
    """
    if not parts:
        return found == earlier
    folders = {Path(name).parent for name in found.keys() | whole.keys() if "summary" not in name}
    below = [[{n: t for n, t in of.items() if Path(n).parent == f} for of in (found, earlier, whole)] for f in folders]
    return all(now in (before, after) for now, before, after in below)


def small_runs(folder: Path) -> dict[str, SmallRun]:
    """Write the inputs of all runs into a folder; return the runs by their titles."""
    import pyarrow.csv as csv
    import pyarrow.parquet as pq
    import yaml

    from stereophd.cli.app import run

    def done(*words: object) -> None:
        code = run([str(word) for word in words])
        if code:
            raise RuntimeError(f"exit code {code}: {words}")

    scene, unknown, tracked = folder / "scene", folder / "unknown", folder / "tracked"
    small = ("--set", "simulate.duration_s=2")
    film = ("--set", "simulate.duration_s=10", "--set", "calibration.annealed.starts=2")
    done("simulate", QUICKSTART, "--out", scene, *small, "-q")
    done("simulate", CALIBRATION, "--out", unknown, *film, "-q")
    done("track", QUICKSTART, scene / "detections.parquet", "--out", tracked, "-q")
    table = pq.read_table(scene / "detections.parquet", columns=["camera", "frame", "u_px", "v_px"])
    csv.write_csv(table, folder / "points.csv")
    log, tracks, cameras = scene / "detections.parquet", tracked / "tracks.parquet", scene / "cameras.yaml"
    track = ("track", QUICKSTART, log)
    rig = ("--cameras", unknown / "guess.yaml", *film[2:], "--no-plots")
    calibrate = ("calibrate", CALIBRATION, unknown / log.name, *rig)
    study = yaml.safe_load(EXPERIMENT.read_text(encoding="utf-8"))
    study["experiment"]["runs"], study["experiment"]["scenario"]["reference_samples"] = 3, 2000
    study["experiment"]["methods"] = dict(list(study["experiment"]["methods"].items())[:2])
    (folder / "experiment.yaml").write_text(yaml.safe_dump(study), encoding="utf-8")
    experiment = ("experiment", folder / "experiment.yaml")
    runs: dict[str, tuple[tuple[object, ...], str, bool]] = {
        "simulate": (("simulate", QUICKSTART, *small), "out", False),
        "simulate --runs 3": (("simulate", QUICKSTART, *small, "--runs", 3), "out", False),
        "simulate --runs 3 --jobs 2": (("simulate", QUICKSTART, *small, "--runs", 3, "--jobs", 2), "out", False),
        "track": (track, "out", True),
        "track --smooth --associations": ((*track, "--smooth", "--associations"), "out", True),
        "track --pieces": ((*track, "--pieces", 1, "--overlap", 0.3), "out", True),
        "track --pieces --jobs 2": ((*track, "--pieces", 1, "--overlap", 0.3, "--jobs", 2), "out", True),
        "track of two logs": (("track", QUICKSTART, log, folder / "again" / log.name), "out", True),
        "calibrate": ((*calibrate, "--jobs", 1), "out", True),
        "calibrate --jobs 2": ((*calibrate, "--jobs", 2), "out", True),
        "evaluate": (("evaluate", tracks, scene / "truth.parquet", "--cutoff", 1, "--no-plots"), "out", False),
        "evaluate-cameras": (("evaluate-cameras", unknown / "guess.yaml", unknown / "cameras.yaml"), "out", False),
        "experiment": (experiment, "out", True),
        "experiment --jobs 2": ((*experiment, "--jobs", 2), "out", True),
        "import": (("import", "csv", folder / "points.csv", "--cameras", cameras, "--fps", 20), "out", False),
        "export csv": (("export", "csv", tracks), "tracks.csv", False),
        "export colmap": (("export", "colmap", cameras), "model", False),
        "report": (("report", tracked, "--log", log), "page.html", False),
        "init": (("init", "--log", log, "--cameras", cameras), "new", False),
    }  # fmt: skip
    (folder / "again").mkdir()
    (folder / "again" / log.name).write_bytes(log.read_bytes())
    return {
        title: SmallRun(tuple(map(str, words)), out, resumes, title == "track of two logs")
        for title, (words, out, resumes) in runs.items()
    }
