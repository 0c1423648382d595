"""How much memory a calibration is going to need, estimated before it begins."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stereophd.pipeline.runs.sizes import Size

if TYPE_CHECKING:
    from stereophd.config.calibration import CalibrationConfig

# Memory of a hypothesis for each detection of a frame (13 kB in one run of 256 hypotheses), and of a detection
# (assumed).
_HYPOTHESIS_BYTES, _DETECTION_BYTES = 8e3, 1e3


def size_of_calibration(section: CalibrationConfig, frames: float, detections: float) -> Size:
    """Estimate memory, not disk (outputs are small), from frames and detections of the log, of all cameras together."""
    hypotheses = 0
    if section.method == "sequential":
        settings = section.sequential
        hypotheses = settings.particles
        if settings.moves == "rerun":
            hypotheses = max(settings.particles, settings.first_particles)
    elif section.posterior == "smc":
        hypotheses = section.smc.particles
    each = _HYPOTHESIS_BYTES * (1.0 + detections / max(frames, 1.0))
    cause = f"{frames:.3g} frames, {detections:.3g} detections"
    cause += f", {hypotheses:.3g} camera hypotheses" if hypotheses else ""
    return Size(detections * _DETECTION_BYTES + hypotheses * each, 0.0, cause)
