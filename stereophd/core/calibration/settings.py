"""Settings of the methods of calibration."""

from typing import Annotated, Literal

from annotated_types import Interval, Len

from stereophd.core.settings import FINITE, LARGEST_COUNT, Count, Fraction, parameter, settings

# Factors on the noise of the detections, pass by pass.
Inflation = Annotated[tuple[Annotated[float, Interval(ge=1, le=1e6), FINITE], ...], Len(1, 1000)]

# Effective share of the particles: steps that keep nearly all of them effective would never end.
EffectiveShare = Annotated[float, Interval(ge=1e-30, le=0.99), FINITE]


@settings
class AnnealedSettings:
    """Annealed alternation of tracking and bundle adjustment, from several starts."""

    starts: Count | None = parameter(
        "the prior mean and draws from the prior; at most this many; null: 24 where poses alone are unknown, and 8 "
        "otherwise, where a start costs more",
        default=None,
    )
    agreeing_starts: Count = parameter("stop as soon as this many of the starts agree on the best", default=2)
    inflation: Inflation = parameter(
        "factors on the detector's sigma while tracking, pass by pass; where tracks pair, those that their residuals "
        "reach, or the last one",
        default=(7.0, 5.0, 3.5, 2.0, 1.4, 1.0),
    )
    max_events: Count = parameter(
        "frames that are tracked, about; of a longer log a part: instants that are spread over it, or stretches of it, "
        "whichever holds more detections of objects that can be followed",
        default=4000,
    )
    max_detections: Count = parameter(
        "detections, false ones among them, that cameras are fitted to; of a log with more a part, chosen in the same "
        "way; the report has how much was used",
        default=150_000,
        advice="more where a log of an hour is to be used whole: time grows with the detections.",
    )
    min_detections: Annotated[int, Interval(ge=4, le=LARGEST_COUNT)] = parameter(
        "a track is used from this many detections in each of two cameras on", default=16
    )
    shared_error_px: Annotated[float, Interval(ge=0, le=1e6), FINITE] = parameter(
        "successive detections of one object within this distance may share an error, as those of an object that "
        "hovers do; the size of that error is estimated from the residuals; 0: all errors are independent",
        default=60.0,
        unit="px",
    )
    one_camera_tracks: Literal["filter", "image"] = parameter(
        "how the detections of each camera alone are linked: by the filter, or in the image, where a track ends as "
        "soon as its next detection is ambiguous",
        default="filter",
        advice="image for many objects close together, such as corners of a board.",
    )
    min_tracked: Fraction = parameter(
        "a start succeeds only if tracks that two cameras share explain this part of the detections that are not "
        "expected to be false",
        default=0.5,
    )


@settings
class SequentialSettings:
    """Single-cluster PHD filter: camera particles, each with a filter of its own (paper VII-B)."""

    moves: Literal["rerun", "none"] = parameter(
        "rerun: Metropolis moves that run the conditional filter again, first at inflated noise, then for more and "
        "more of the log; none: the paper's plain filter, with jitter after resampling",
        default="rerun",
    )
    particles: Count = parameter("camera hypotheses", default=128, advice="1500 with moves: none (the paper's number).")
    first_particles: Count = parameter(
        "camera hypotheses while the noise is inflated, at least `particles` (moves: rerun)",
        default=256,
        advice="more for wider priors.",
    )
    block_events: Count = parameter("events of the first block; later stages double them (moves: rerun)", default=30)
    inflation: Inflation = parameter(
        "factors on the detector's sigma in the first block (moves: rerun)", default=(7.0, 5.0, 3.5, 2.0, 1.4, 1.0)
    )
    moves_per_step: Count = parameter("moves after each resampling (moves: rerun)", default=2)
    resample_below: EffectiveShare = parameter(
        "resample when the effective sample size falls below this part of the particles", default=0.4
    )
    roughening: Annotated[float, Interval(ge=0, le=1e3), FINITE] = parameter(
        "after resampling, jitter of this factor times range times particles^(-1/parameters) (moves: none)", default=0.2
    )
    likelihood: Literal["pmb", "phd"] = parameter("multi-object likelihood that weights the particles", default="pmb")
    samples: Annotated[int, Interval(ge=16, le=65536)] = parameter(
        "samples per Gaussian of the particle move of likelihood phd", default=100
    )


@settings
class TemperedSettings:
    """Full posterior: particles about the modes found, tempered and moved by Metropolis-Hastings."""

    particles: Annotated[int, Interval(ge=8, le=LARGEST_COUNT)] = parameter("camera hypotheses", default=200)
    evidence: Literal["pmb", "phd"] = parameter("multi-object evidence that weights the particles", default="pmb")
    resample_below: EffectiveShare = parameter(
        "a tempering step keeps the effective sample size at this part of the particles", default=0.5
    )
    moves: Count = parameter("Metropolis-Hastings moves after each tempering step", default=3)
    spread: Annotated[float, Interval(ge=0.1, le=1e3), FINITE] = parameter(
        "the first particles are drawn this much wider than the Laplace modes", default=1.5
    )
