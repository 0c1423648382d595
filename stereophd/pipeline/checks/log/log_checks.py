"""Checks that need the log alone: times, frames, pixels and the statements about the detectors."""

from collections.abc import Collection, Iterator
from itertools import combinations

import numpy as np

from stereophd.core.geometry.pose import Pose
from stereophd.core.settings import LATEST_S
from stereophd.pipeline.checks.finding import Finding, Status, is_mistake
from stereophd.pipeline.checks.log.sample import CLOSE, MOST_BY_CHANCE, CameraSample
from stereophd.wording import instant, percent, span

# Relative difference of frame rates that is reported.
RATE_TOLERANCE = 0.02
# A camera without a stated frame rate and with a longer interval seems to have its times in a smaller unit, s.
LONGEST_INTERVAL_S = 10.0
# Such units, with how many of them a second has, and the relative difference of rates that are the same but for one.
UNITS, SAME_RATE = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}, 0.1
# Least noise that is proposed, px.
LEAST_SIGMA_PX = 0.01
# Expected false detections of a frame over detections of a frame.
CLUTTER_FACTOR = 1.5
# Detections of a frame that no neighbouring frame continues, over the stated clutter; and at least this many.
ISOLATED_FACTOR, LEAST_ISOLATED = 5.0, 0.3
# Share of the detections in chains that go on, over the probability of detection, from which chains follow objects.
LEAST_CONTINUED = 0.9
# Share of the detections that lie beside another, and their number, from which tracks multiply.
MOST_CLOSE, LEAST_CLOSE = 0.2, 30
# Measured over stated noise of a detection.
NOISE_FACTOR = 4.0
# Share of the shorter period that the periods of two cameras must share.
LEAST_OVERLAP = 0.05
# Share of the frames that repeat the one before, from which tracks lag.
MOST_REPEATED = 0.01
# Places that are named, and the radius in which their detections may be left out, px.
MOST_SHOWN, PLACE_RADIUS_PX = 5, 2.0
# Difference of the logarithms of what the coordinates of a principal point are scaled by in another resolution.
SCALED_ALIKE = 0.2
# Relative difference of the image whose centre a principal point is within which it is the stated one, and from which
# on it is not.
NEAR_CENTRE, FAR_FROM_CENTRE = 0.2, 0.49
# Focal lengths over the smaller side of the image are larger, of fisheyes too: 0.32 where it holds half a sphere.
SHORTEST_FOCAL = 0.2


def check_files(
    samples: list[CameraSample], whole: bool = True, unknown_clocks: Collection[str] = (),
    estimated: Collection[str] = (),
) -> Iterator[Finding]:  # fmt: skip
    """Yield findings on frames, pixels and detectors of every camera; having no frames is one only in a `whole` log.

    Of cameras of `unknown_clocks` nobody knows when they recorded, and those `estimated` state no detector.
    """
    untimed = set(unknown_clocks)
    for sample in samples:
        if not len(sample.times):
            if not whole:
                continue
            yield Finding(
                "log.frames", "warning", f"{sample.camera.name}: the log has no frame of this camera",
                0, None, sample.camera.name, "check the name of the camera in the log", "camera_without_frames",
            )  # fmt: skip
            continue
        frames = list(check_times(sample))
        untimed |= {found.camera for found in frames if found.camera is not None and is_mistake(found)}
        yield from frames
        yield _image(sample)
        yield from _places(sample)
        if (repeated := sample.repeated_share) > MOST_REPEATED:
            yield Finding(
                "log.frames", "warning",
                f"{sample.camera.name}: {percent(repeated)} of the frames have the detections of the frame before to "
                "the last digit: frames are repeated, and show objects where they were", round(repeated, 3), 0.0,
                sample.camera.name, "leave the repeated frames out of the log", "frames_repeated",
            )  # fmt: skip
        is_stated = sample.camera.name not in estimated
        yield from (one for one in _detector(sample) if is_stated or not one.name.startswith("detector."))
    seen = [sample.camera.name for sample in samples if len(sample.pixels)]
    if whole and len(seen) < 2 <= len(samples):
        yield Finding(
            "log.detections", "warning",
            f"{f'only {seen[0]}' if seen else 'no camera'} has detections: depths need two cameras", len(seen), 2, None,
            "check the names of the cameras in the log, and that it has the detections of all", "too_few_cameras",
        )  # fmt: skip
    yield from _poses([sample for sample in samples if len(sample.times)])
    yield from _periods([sample for sample in samples if len(sample.times) > 1 and sample.camera.name not in untimed])


def _poses(samples: list[CameraSample]) -> Iterator[Finding]:
    """Yield a warning for every two cameras of one pose and focal length; unknown ones all stand at the origin."""
    placed = [one.camera for one in samples if one.camera.pose != Pose(np.eye(3), np.zeros(3))]
    for first, second in combinations(placed, 2):
        # two sensors in one housing may be stated at one place, but have not one focal length
        if (first.pose, first.fx) != (second.pose, second.fx):
            continue
        yield Finding(
            "camera.pose", "warning", f"{second.name}: pose and focal length are those of {first.name} to the last "
            "digit: one seems a copy of the other", 0.0, None, second.name,
            "correct the file of cameras, or calibrate with `pose: unknown`", "poses_equal",
        )  # fmt: skip


def check_times(sample: CameraSample) -> Iterator[Finding]:
    """Yield whether the frames come at the stated rate, in seconds; nothing of fewer than three."""
    name, rate = sample.camera.name, sample.camera.frame_rate_hz
    if len(sample.times) < 3:
        return
    found = 1.0 / sample.interval_s if sample.interval_s > 0.0 else float("inf")
    # frames without a row, or whose times jitter, are not frames of another rate
    by_number = float(np.ptp(sample.frames)) / max(float(np.ptp(sample.times)), 1e-300)
    is_off = rate is not None and min(abs(found / rate - 1.0), abs(by_number / rate - 1.0)) > RATE_TOLERANCE
    since, unit = sample.times - sample.times[0], _unit(sample, found)
    text, remedy, cause = f"frames come at {found:.4g} Hz", None, None
    if (
        rate is not None
        and is_off
        and rate > 1.5
        and np.allclose(since, np.round(since), atol=1e-6)
        and round(np.diff(since).min()) == 1
    ):
        text, cause = f"{text}, frame_rate_hz is {rate:g}: the times seem to be frame numbers", "frame_number_as_time"
        remedy = f"divide time_s by the frame rate, {rate:g} Hz"
    elif unit is not None:
        text, cause = f"{text}, and times reach {sample.times[-1]:.6g} s: they seem to be in {unit}", unit
        remedy = f"divide time_s by {UNITS[unit]:.0f}, or import a log again with their unit (`time_unit`)"
        remedy += "; or state frame_rate_hz if the interval is right" if rate is None else ""
    elif is_off:
        text, cause = f"{text}, frame_rate_hz is {rate:g}: the times do not fit the stated frame rate", "frame_rate"
        remedy = "check the frame rate from which the times were computed, and the one that is stated"
    status: Status = "ok" if cause is None else "warning"
    yield Finding("log.frame_rate", status, f"{name}: {text}", round(found, 6), rate, name, remedy, cause)


def _unit(sample: CameraSample, found: float) -> str | None:
    """Return the unit in which the times, with frames at this rate, are the stated or usual ones; None: in seconds."""
    rate, latest = sample.camera.frame_rate_hz, abs(sample.times[-1])
    is_long = latest > LATEST_S or (rate is None and sample.interval_s > LONGEST_INTERVAL_S)
    for unit, parts in UNITS.items():
        is_usual = sample.interval_s / parts <= LONGEST_INTERVAL_S and latest / parts <= LATEST_S
        if (is_long and is_usual) or (rate is not None and abs(found * parts / rate - 1.0) < SAME_RATE):
            return unit
    return None


def _image(sample: CameraSample) -> Finding:
    """Return whether pixels, the size of the image and the principal point fit one another."""
    camera, size = sample.camera, np.array([sample.camera.width, sample.camera.height], dtype=float)
    name, is_shown = camera.name, len(sample.pixels) >= 20
    low, high = (sample.pixels.min(axis=0), sample.pixels.max(axis=0)) if is_shown else (np.zeros(2), size - 1.0)
    if is_shown and (high <= 1.5).all() and (low >= -0.5).all():
        return Finding(
            "log.pixels", "warning", f"{name}: all pixels lie between 0 and 1: they seem to be normalised",
            float(high.max()), float(size.max()), name, "multiply u by the width and v by the height",
            "pixels_normalised",
        )  # fmt: skip
    # another resolution scales both alike; a cut image, or a long lens, has its principal point anywhere
    other = 2.0 * np.array([camera.cx, camera.cy]) + 1.0
    centre, exchanged = other / size, other / size[::-1]
    is_alike = (centre > 0.0).all() and abs(np.log(centre[0] / centre[1])) < SCALED_ALIKE
    point, cause = f"the principal point ({camera.cx:g}, {camera.cy:g}) is far from the centre of the image", None
    if (np.abs(exchanged - 1.0) < NEAR_CENTRE).all() and (np.abs(centre - 1.0) > NEAR_CENTRE).all():
        cause, text = "width_height_exchanged", f"{point}: width and height seem to be exchanged"
        remedy = f"set cameras.{name}.image_size_px to [{camera.height}, {camera.width}]"
    elif is_alike and (np.abs(centre - 1.0) > FAR_FROM_CENTRE).any():
        cause, text = "principal_point_resolution", f"{point}: it seems to belong to another resolution"
        remedy = "state cx and cy in pixels of this image size"
        # the image whose centre it is holds all detections, and the stated one does not, or is larger for nothing
        if is_shown and (high < other).all() and ((high > size).any() or (other < size).all()):
            filled = (
                f"the detections fill {percent(high[0] / size[0])} of its width and {percent(high[1] / size[1])} of "
            )
            cause, text = "image_size", f"{point}, and {filled} its height: the image size seems to be wrong"
            remedy = "set cameras.{}.image_size_px to [{:.0f}, {:.0f}]".format(name, *other)
    if cause is None:
        return Finding("log.pixels", "ok", f"{name}: pixels and principal point fit the image", camera=name)
    check, value = "log.pixels" if cause == "image_size" else "camera.principal_point", round(float(centre.max()), 3)
    return Finding(check, "warning", f"{name}: {text}", value, 1.0, name, remedy, cause)


def _places(sample: CameraSample) -> Iterator[Finding]:
    """Yield a warning about places that detect again and again."""
    places = sample.lasting_places
    if not places:
        return
    shown = ", ".join(f"({u:.1f}, {v:.1f}) in {frames}" for (u, v), frames in places[:MOST_SHOWN])
    more = f" and {len(places) - MOST_SHOWN} more" if len(places) > MOST_SHOWN else ""
    areas = ", ".join(f"[{u:.1f}, {v:.1f}, {PLACE_RADIUS_PX:g}]" for (u, v), _ in places[:MOST_SHOWN])
    name = sample.camera.name
    yield Finding(
        "log.places", "warning",
        f"{name}: the same places detect again and again: {shown} of {len(sample.times)} frames{more}: dead pixels, "
        "lamps, or objects at rest", len(places), 0, name,
        f"if they are no objects, leave them out: input.leave_out.{name}=[{areas}]", "lasting_places",
    )  # fmt: skip


def _detector(sample: CameraSample) -> Iterator[Finding]:
    camera, detector = sample.camera, sample.camera.detector
    rate = sample.detections_per_frame
    if detector.clutter_per_frame > CLUTTER_FACTOR * rate + 3.0 * np.sqrt((rate + 1.0) / len(sample.times)):
        yield Finding(
            "detector.clutter", "warning",
            f"{camera.name}: clutter_per_frame is {detector.clutter_per_frame:g}, but a frame has only {rate:.3g} "
            "detections",
            detector.clutter_per_frame, round(rate, 3), camera.name,
            "state the false detections of a frame, or estimate them (detector: estimate)", "clutter",
        )  # fmt: skip
    # where noise or motion outrun the chains, or chance links them, what they leave over are objects, and what they
    # hold is not one object; what is missed before and after is left over too
    continued, by_chance = sample.continued_share or 0.0, sample.linking[1]
    is_linked = by_chance <= MOST_BY_CHANCE
    follows = continued >= LEAST_CONTINUED * detector.p_detect and is_linked
    missed = max(rate - detector.clutter_per_frame, 0.0) * (1.0 - continued) ** 2
    isolated = sample.isolated_per_frame - missed
    # chains that hold less than half of the detections say nothing of the others: a board that leaps moves them all;
    # a link by chance takes the place of one of objects, and leaves over as many
    least = max(LEAST_ISOLATED, ISOLATED_FACTOR * detector.clutter_per_frame, 0.15 * rate) + by_chance * rate
    many = least < isolated < 0.5 * rate
    if follows and many:
        yield Finding(
            "detector.clutter", "warning",
            f"{camera.name}: {isolated:.2g} detections of a frame are continued by none of the next frames, but "
            f"clutter_per_frame is {detector.clutter_per_frame:g}",
            detector.clutter_per_frame, round(isolated, 3), camera.name,
            f"set clutter_per_frame near {isolated:.2g}, or estimate it (detector: estimate)", "clutter",
            f"cameras.{camera.name}.detector.clutter_per_frame={isolated:.2g}",
        )  # fmt: skip
    if (close := sample.close_share) > MOST_CLOSE and close * len(sample.pixels) > LEAST_CLOSE:
        yield Finding(
            "detector.pairs", "warning",
            f"{camera.name}: {percent(close)} of the detections have another one of their frame within "
            f"{CLOSE:g} deviations of the noise, beyond chance: the detector reports objects twice, so that tracks "
            "multiply, or objects move so near one another that tracks may swap", round(close, 3), 0.0, camera.name,
            "if it reports one object twice, let it suppress all but the best of detections that overlap "
            "(non-maximum suppression)",
            "detections_doubled",
        )  # fmt: skip
    yield _noise(sample, is_linked)
    shortest = SHORTEST_FOCAL * min(camera.width, camera.height)
    if camera.fx < shortest:
        yield Finding(
            "camera.focal_length", "warning",
            f"{camera.name}: fx = {camera.fx:g} px is less than {percent(SHORTEST_FOCAL)} of the smaller side of the "
            "image, shorter than that of any lens: the focal length seems to be in millimetres",
            camera.fx, shortest, camera.name,
            "divide it by the pixel pitch: focal length [px] = focal length [mm] * image width [px] / sensor width "
            "[mm]", "focal_length_millimetres",
        )  # fmt: skip


def _noise(sample: CameraSample, is_linked: bool) -> Finding:
    """Return whether the stated noise is that of the detections of chains, which must not be those of chance."""
    name, stated = sample.camera.name, float(sample.camera.detector.sigma.mean())
    known = sample.noise_px if is_linked else None
    if known is None and sample.rounding_px <= NOISE_FACTOR * stated:
        why = "chance links them" if sample.noise_px else "too few lie on one-camera tracks"
        why += " of objects that move (pixels are whole numbers)" if sample.rounding_px and not sample.noise_px else ""
        return Finding("detector.sigma", "not checked", f"{name}: the noise of detections: {why}", stated, camera=name)
    noise, least, most = known or (sample.rounding_px, sample.rounding_px, np.inf)
    what = "about one-camera tracks" if known else "because pixels are whole numbers"
    size = f"about {noise:.2g}" if noise >= LEAST_SIGMA_PX else f"at most {most:.2g}"
    text = f"{name}: detections scatter by {size} px {what}, sigma_px is {stated:g}"
    too_large, better = most * NOISE_FACTOR < stated, f"{max(noise, LEAST_SIGMA_PX):.2g}"
    if least <= NOISE_FACTOR * stated and not too_large:
        return Finding("detector.sigma", "ok", text, stated, round(noise, 4), name)
    effect = ": rays meet anywhere with it, so that neither clocks nor poses show their errors" if too_large else ""
    return Finding(
        "detector.sigma", "warning", f"{text}{effect}", stated, round(noise, 4), name,
        f"set sigma_px near {better}, or estimate it (detector: estimate)", "sigma",
        f"cameras.{name}.detector.sigma_px=[{better}, {better}]",
    )  # fmt: skip


def _periods(samples: list[CameraSample]) -> Iterator[Finding]:
    """Yield whether the periods of the cameras overlap."""
    if len(samples) < 2:
        return
    middles = np.array([0.5 * (sample.times[0] + sample.times[-1]) for sample in samples])
    for k, sample in enumerate(samples):
        others = [one for one in samples if one is not sample]
        start = float(np.median([one.times[0] for one in others]))
        end = float(np.median([one.times[-1] for one in others]))
        shared = min(end, sample.times[-1]) - max(start, sample.times[0])
        shortest = max(min(end - start, sample.times[-1] - sample.times[0]), 1e-9)
        if shared < LEAST_OVERLAP * shortest and (len(samples) > 2 or k == int(np.argmax(np.abs(middles)))):
            ratio = (sample.times[-1] - sample.times[0]) / max(end - start, 1e-300)
            odd = "runs at another rate" if abs(np.log(max(ratio, 1e-300))) > 0.5 else "is on another clock"
            yield Finding(
                "log.periods", "warning",
                f"{sample.camera.name}: its frames lie between {instant(sample.times[0])} and "
                f"{instant(sample.times[-1])} s, those of the other cameras between "
                f"{instant(start)} and {instant(end)} s: it {odd}",
                round(max(shared, 0.0) / shortest, 3), 1.0, sample.camera.name,
                "check the unit of its times; give its clock (clock.offset_s, clock.rate)",
                "clock_rate" if "rate" in odd else "clock_offset",
            )  # fmt: skip
            return
    lengths = sorted(sample.times[-1] - sample.times[0] for sample in samples)
    text = f"the periods of the cameras overlap; frames of {span(lengths[0], lengths[-1])} s were examined"
    yield Finding("log.periods", "ok", text)
