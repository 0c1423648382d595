"""One run of `calibrate`: what every method works on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from stereophd.config.calibration import CalibrationConfig
from stereophd.pipeline.calibration.inputs import CalibrationProblem
from stereophd.pipeline.calibration.unknowns import calibration_section
from stereophd.pipeline.runs.progress import Progress
from stereophd.pipeline.runs.unfinished import UnfinishedRun

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig


@dataclass(frozen=True)
class CalibrationRun:
    """A problem with its configuration, and how it is worked on."""

    loaded: LoadedConfig
    problem: CalibrationProblem
    unfinished: UnfinishedRun
    jobs: int = 1  # Processes, or threads of particles
    progress: Progress | None = None  # Called with (done, total)

    @property
    def section(self) -> CalibrationConfig:
        """The ``calibration`` section."""
        return calibration_section(self.loaded)

    @property
    def seed(self) -> int:
        """Seed of the configuration."""
        return self.loaded.config.seed

    def report_progress(self, done: int, total: int) -> None:
        """Tell how much is done."""
        if self.progress is not None:
            self.progress(done, total)
