"""Small errors of clock, lens and pose: rays meet, but their distances depend on speed or on the place in the image.

One-camera tracks of two cameras that meet most of the time belong to one object. The signed distance of their rays from
meeting, in standard deviations, is white noise of mean 0 if the set-up is right. An offset of a clock adds what the
object moves in that time, an error of a lens grows from the centre of the image, and an error of a pose is a smooth
function of the place. Each cause is fitted separately; the one that explains most of the distances is named. Standard
errors follow from the spread between pairs of tracks, so that errors that last do not pass for evidence.
"""

from collections.abc import Iterator

import numpy as np

from stereophd.core.arrays import Array
from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.checks.geometry.causes import shift_remedy, shifted
from stereophd.pipeline.checks.geometry.measure import pairs_of
from stereophd.pipeline.checks.log.sample import CameraSample
from stereophd.pipeline.checks.residuals.causes import PairFits, explain
from stereophd.pipeline.checks.residuals.partners import Partners, partners, track_velocities
from stereophd.wording import percent

# A cause with one number is preferred to a pose that explains less than this many times as much.
PREFERENCE = 1.35
# Cameras that explain this share of what the best one explains are named with it.
ALIKE = 0.97
# Lateness of one clock over that of a pair, from which it is what the pair shows.
LEAST_CHANGE = 0.5
ESTIMATE_LENS = "let calibrate estimate it (calibration.priors.NAME.distortion_std: {k1: 0.1})"
CAUSES = {
    "clock": "clock_offset", "lens": "lens_inaccurate", "lenses": "lens_missing", "pose": "pose_inaccurate",
}  # fmt: skip


def check_residuals(samples: list[CameraSample]) -> Iterator[Finding]:
    """Yield a finding if the clock, lens or pose of a camera seems to be slightly off, else one for each pair.

    The middle of a box is not the image of one point of the object, which looks like an error of a pose: where
    detections are boxes no pose is called off.
    """
    motion = [track_velocities(sample) for sample in samples]
    pairs = [found for a, b in pairs_of(len(samples)) if (found := partners(samples, motion, a, b))]
    fits = [explain(pair, samples[pair.a].camera, samples[pair.b].camera) for pair in pairs]
    together = list(zip(pairs, fits, strict=True))
    ignored = {"pose"} if any(sample.boxes for sample in samples) else set()
    causes = [fit.decisive(pair.track_count) - ignored for pair, fit in together]
    suspicious = [both for both, decisive in zip(together, causes, strict=True) if decisive]
    if suspicious and (warning := _warning(samples, suspicious, together, set().union(*causes))) is not None:
        yield warning
        return
    for pair in pairs:
        names = f"{samples[pair.a].camera.name} and {samples[pair.b].camera.name}"
        mean, spread = float(pair.distance.mean()), float(pair.distance.std())
        yield Finding(
            "geometry.residuals", "ok",
            f"{names}: the rays of {pair.track_count} pairs of tracks miss each other by {mean:+.2f} +- {spread:.2f} "
            f"standard deviations, correlation from frame to frame {pair.correlation:.2f}",
            round(spread, 3), 1.0,
        )  # fmt: skip


def _warning(
    samples: list[CameraSample],
    suspicious: list[tuple[Partners, PairFits]],
    everything: list[tuple[Partners, PairFits]],
    decisive: set[str],
) -> Finding | None:
    """Return the finding that names the cause and the camera that explain most over all suspicious pairs.

    A cause is decisive for at least one pair, and undoing it must change something: pairs whose clocks contradict each
    other leave every clock as it is. None where no cause is left.
    """
    lateness = _lateness(len(samples), everything)
    totals: dict[tuple[str, int], float] = {}
    count = [sum(c in (pair.a, pair.b) for pair, _ in everything) for c in range(len(samples))]
    for pair, fits in suspicious:
        for camera, lens in ((pair.a, fits.lens_a), (pair.b, fits.lens_b)):
            for cause, explained in (
                ("clock", fits.clock.explained), ("lens", lens.explained), ("pose", fits.pose.explained / PREFERENCE),
            ):  # fmt: skip
                changes = cause != "clock" or abs(lateness[camera]) >= LEAST_CHANGE * abs(fits.clock.value)
                if cause not in decisive or not changes:
                    continue
                totals[cause, camera] = totals.get((cause, camera), 0.0) + explained / count[camera]
    joint = sum(fits.lenses.explained for _, fits in suspicious) if "lenses" in decisive else 0.0
    if not totals and not joint:
        return None
    (cause, camera), best = max(totals.items(), key=lambda one: one[1], default=(("lenses", 0), 0.0))
    cameras = [c for (one, c), total in totals.items() if one == cause and total >= ALIKE * best]
    names = " or ".join(samples[c].camera.name for c in sorted(cameras))
    if joint and joint >= ALIKE * best * count[camera]:
        # one camera explains no more of the pairs that it has than all together
        alone = f", or that of {names} alone" if ALIKE * joint <= best * count[camera] else ""
        cause, cameras, names = "lenses", [], f"all cameras that state no lens{alone}"
    share = max(fits.of(cause).explained for _, fits in suspicious)
    text = f"{names}: the distances of rays from those of other cameras"
    change, value = None, max(fits.of(cause).effect for _, fits in suspicious)
    if cause == "clock":
        # of two cameras the log does not show which one
        latest = cameras[0] if len(cameras) == 1 else max(cameras, key=lambda c: float(lateness[c]))
        late = float(lateness[latest])
        text += f" follow the speed of the objects: its clock seems to be off by {late:+.3g} s"
        remedy, value, change = shift_remedy(-late), late, shifted(samples[latest], -late)
    elif cause == "lens":
        text += " grow from the centre of the image outwards: its lens coefficients seem to be off"
        remedy = f"calibrate the lens again, or {ESTIMATE_LENS}"
    elif cause == "lenses":
        weights = np.array([1.0 / max(fits.lenses.error, 1e-9) ** 2 for _, fits in suspicious])
        value = float(weights @ [fits.lenses.value for _, fits in suspicious] / weights.sum())
        text += f" grow from the centre of the image outwards: the lens seems to be missing, near k1 = {value:.2g}"
        remedy = f"state the lens distortion, or {ESTIMATE_LENS}"
    else:
        text += " depend on the place in the image: its pose seems to be slightly off"
        remedy = "let calibrate refine the poses, starting from these cameras"
    return Finding(
        "geometry.residuals", "warning", f"{text} (this explains {percent(share)} of their squares)", round(value, 5),
        0.0, names if len(cameras) == 1 else None, remedy, CAUSES[cause], change,
    )  # fmt: skip


def _lateness(count: int, pairs: list[tuple[Partners, PairFits]]) -> Array:
    """Return by how much the times of each camera in the log are late (n,), s; the middle camera is right."""
    design = np.array([np.eye(count)[pair.b] - np.eye(count)[pair.a] for pair, _ in pairs])
    weight = np.array([1.0 / max(fits.clock.error, 1e-6) for _, fits in pairs])
    found = np.array([fits.clock.value for _, fits in pairs])
    late: Array = np.linalg.lstsq(design * weight[:, None], found * weight, rcond=1e-9)[0]
    return late - np.median(late) if count > 2 else 2.0 * late
