"""Every random stream of the package: its purpose, and where its numbers come from.

Most streams come from the seed of the configuration: such a stream is
``numpy.random.SeedSequence(seed, spawn_key=path)``, with a path of keys for each purpose. No two purposes share a path,
so their numbers are independent. Numbers below 2**31 at the beginning of a path count the runs of ``simulate`` and
``experiment``; purposes of a whole configuration begin at 2**31.

The receiver of a stream may spawn children from it, for example one for each camera, start of a calibration or step;
their paths begin with the path of the stream.

Streams of a fixed seed do not depend on the configuration: their numbers make a rule, so that equal inputs give equal
results whatever the seed is.
"""

from dataclasses import dataclass

import numpy as np

# Paths of purposes of the whole configuration begin with this number or a greater one.
FIRST_KEY = 2**31


@dataclass(frozen=True)
class Purpose:
    """A purpose of random numbers."""

    path: tuple[int, ...]  # Keys from the seed of the configuration
    commands: tuple[str, ...]  # Commands that draw from this stream
    what: str

    def seed(self, seed: int) -> np.random.SeedSequence:
        """Return the stream for the seed of a configuration."""
        return np.random.SeedSequence(seed, spawn_key=self.path)


@dataclass(frozen=True)
class RunPurpose:
    """A purpose of random numbers within one run."""

    path: tuple[int, ...]  # Keys after the number of the run
    commands: tuple[str, ...]
    what: str

    def seed(self, seed: int, run: int) -> np.random.SeedSequence:
        """Return the stream of a run, independent of the number of runs, for the seed of a configuration."""
        return np.random.SeedSequence(seed, spawn_key=(run, *self.path))


# One run of `simulate` or `experiment`.
RUN_OBJECTS = RunPurpose((0,), ("simulate", "experiment", "evaluate"), "paths of the objects of a scene")
RUN_FRAMES = RunPurpose((1,), ("simulate", "experiment"), "detections, misses and clutter of the cameras")
RUN_GUESS = RunPurpose((2,), ("simulate", "experiment"), "cameras at which a calibration begins")
RUN_METHOD = RunPurpose((3,), ("experiment",), "seed of the calibration itself")

# A run of an experiment with one object draws all its numbers from one stream, in turn.
RUN_SINGLE_OBJECT = RunPurpose((), ("experiment of one object",), "truth, detections and estimator of one object")

# The whole configuration.
FILTER_SAMPLES = Purpose(
    (FIRST_KEY,), ("track", "calibrate", "experiment"), "sample sets of a filter of many objects"
)  # fmt: skip
CALIBRATION_STARTS = Purpose((FIRST_KEY + 1,), ("calibrate",), "cameras at which the starts of annealed begin")
SEQUENTIAL_PARTICLES = Purpose((FIRST_KEY + 2,), ("calibrate",), "particles of method sequential")
TEMPERED_PARTICLES = Purpose((FIRST_KEY + 3,), ("calibrate",), "particles of posterior smc")
POSTERIOR_DRAWS = Purpose((FIRST_KEY + 4,), ("calibrate",), "draws from the posterior of method annealed")
CALIBRATION_PAIRING = Purpose((FIRST_KEY + 5,), ("calibrate",), "pairing of tracks, one child a start")
CAMERA_DISCOVERY = Purpose((FIRST_KEY + 9,), ("calibrate",), "choice of hypotheses where nothing is known of cameras")
SINGLE_ESTIMATOR = Purpose((FIRST_KEY + 6,), ("track",), "particles and samples of a single-object estimator")
BOUND_TRAJECTORIES = Purpose(
    (FIRST_KEY + 7,), ("experiment", "experiment of one object"), "trajectories over which a bound is averaged"
)
MOVE_REFERENCE = Purpose(
    (FIRST_KEY + 8,), ("experiment", "experiment of one object"), "samples behind the moments that moves compare with"
)

# Streams of a fixed seed. Any number would do; another one changes results a little.
SCRAMBLE_SEED = 5  # scramble of the low-discrepancy points of the estimators of one object
BENDS_SEED = 0  # draws of a posterior of cameras beside which `calibrate` looks at its bend
GROUND_SEED = 0  # triples of places by which `init` finds the ground that bodies stand on
RAY_NOISE_SEED = 0  # draws of the noise of all cameras by which `init` and `track` estimate detectors from rays
NOISE_SEED = 0  # errors that `calibrate` draws to find how much of them a fit absorbs
COMPILED_SAMPLES_SEED = 0  # samples of the small filters that are built to compile the kernels; no result uses them
WARM_UP_SEED = 0  # detections that make the kernels ready before the first frame of a live run; no result uses them


def run_number(seed: int, run: int) -> int:
    """Return the first 63 bits of the stream of a run, its identity: runs on the same data have the same."""
    return int(np.random.SeedSequence(seed, spawn_key=(run,)).generate_state(1, np.uint64)[0] >> 1)
