"""How long a calibration is going to take, estimated before it begins.

The method decides: `annealed` adjusts cameras and trajectories to the detections of a log, start by start; particles
filter the log, each on its own, once or again and again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from stereophd.pipeline.runs.sizes import Size

if TYPE_CHECKING:
    from stereophd.config.calibration import CalibrationConfig
    from stereophd.core.calibration.settings import SequentialSettings, TemperedSettings

# Measured on one core, for estimates of the order of magnitude. Of method annealed: processor time of a small
# calibration with two starts, of a detection in the adjustments, and of one that is also tracked (138 set-ups drawn at
# random, of 300 to 7,000 detections: nine tenths took 0.5 to 3.5 times the estimate, the median 1.0 times).
_RUN_S, _ADJUSTED_S, _TRACKED_S = 2.0, 2e-3, 3e-3
# The defaults that these times belong to.
_STARTS, _PASSES = 2, 6
# Of a camera hypothesis: a detection in the PMB filter, and for each sample in the PHD filter; how many times moves
# and inflated noise repeat the filter. (Paper's scene, 3,200 detections: 1500 hypotheses of the plain filter took 85 s,
# estimated 96; 256 with moves 155 s beside other processes, estimated 98; posterior smc 36 s, estimated 120.)
_PMB_S, _PHD_SAMPLE_S, _REPETITIONS = 4e-6, 2e-7, 10
# Samples of the PHD filter where its settings do not state them.
_PHD_SAMPLES = 64
# Memory of a hypothesis for each detection of a frame (13 kB in one run of 256 hypotheses), and of a detection
# (assumed).
_HYPOTHESIS_BYTES, _DETECTION_BYTES = 8e3, 1e3


def size_of_calibration(section: CalibrationConfig, frames: float, detections: float) -> Size:
    """Estimate the processor time and the memory of a calibration.

    Parameters
    ----------
    section : CalibrationConfig
    frames, detections : float
        Of the log, of all cameras together.

    Returns
    -------
    Size
        Without disk space: the outputs are small.
    """
    cause = f"{frames:.3g} frames, {detections:.3g} detections"
    memory = detections * _DETECTION_BYTES
    if section.method == "sequential":
        settings = section.sequential
        seconds, hypotheses = _filter_seconds(settings, detections), settings.particles
        if settings.moves == "rerun":
            hypotheses = max(settings.particles, settings.first_particles)
        memory += hypotheses * _bytes_of_hypothesis(frames, detections)
        return Size(seconds, memory, 0.0, f"{cause}, {hypotheses:.3g} camera hypotheses")
    seconds = _annealed_seconds(section, frames, detections)
    if section.posterior == "smc":
        kept = detections * min(1.0, section.smc.max_events / max(frames, 1.0))
        seconds += _tempered_seconds(section.smc, kept)
        memory += section.smc.particles * _bytes_of_hypothesis(frames, detections)
        cause += f", {section.smc.particles:.3g} camera hypotheses"
    return Size(seconds, memory, 0.0, cause)


def _annealed_seconds(section: CalibrationConfig, frames: float, detections: float) -> float:
    settings = section.annealed
    starts = settings.agreeing_starts if settings.starts is None else min(settings.starts, settings.agreeing_starts)
    tracked = detections * min(1.0, settings.max_events / max(frames, 1.0)) * len(settings.inflation) / _PASSES
    return starts / _STARTS * (_RUN_S + detections * _ADJUSTED_S + tracked * _TRACKED_S)


def _filter_seconds(settings: SequentialSettings, detections: float) -> float:
    each = _PMB_S if settings.likelihood == "pmb" else _PHD_SAMPLE_S * settings.samples
    if settings.moves == "none":
        return settings.particles * detections * each
    hypotheses = max(settings.particles, settings.first_particles)
    return hypotheses * detections * each * _REPETITIONS * (1 + settings.moves_per_step)


def _tempered_seconds(settings: TemperedSettings, detections: float) -> float:
    each = _PMB_S if settings.evidence == "pmb" else _PHD_SAMPLE_S * _PHD_SAMPLES
    return settings.particles * detections * each * _REPETITIONS * (1 + settings.moves)


def _bytes_of_hypothesis(frames: float, detections: float) -> float:
    return _HYPOTHESIS_BYTES * (1.0 + detections / max(frames, 1.0))
