"""The public names of stereophd, listed once: type checkers read this file, and so does ``__init__.py``."""

from stereophd.commands.align import align as align
from stereophd.commands.batches import calibrate_logs as calibrate_logs
from stereophd.commands.batches import evaluate_runs as evaluate_runs
from stereophd.commands.batches import track_logs as track_logs
from stereophd.commands.calibrate import calibrate as calibrate
from stereophd.commands.check import check as check
from stereophd.commands.evaluate import evaluate as evaluate
from stereophd.commands.evaluate_cameras import evaluate_calibration as evaluate_calibration
from stereophd.commands.experiment import experiment as experiment
from stereophd.commands.init import init as init
from stereophd.commands.simulate import simulate as simulate
from stereophd.commands.track import track as track
from stereophd.config.loading import LoadedConfig as LoadedConfig
from stereophd.config.loading import load_config as load_config
from stereophd.config.loading import make_config as make_config
from stereophd.core.disparity.events import make_event as make_event
from stereophd.core.geometry.camera import Camera as Camera
from stereophd.core.geometry.camera import Clock as Clock
from stereophd.core.geometry.camera import Detector as Detector
from stereophd.core.geometry.lens import Lens as Lens
from stereophd.core.geometry.pose import Pose as Pose
from stereophd.errors import GateError as GateError
from stereophd.errors import InputError as InputError
from stereophd.errors import StereophdError as StereophdError
from stereophd.io.logs.reading import Frame as Frame
from stereophd.pipeline.array_filters import make_filter as make_filter
from stereophd.pipeline.array_filters import run_filter as run_filter
from stereophd.pipeline.files import read_cameras as read_cameras
from stereophd.pipeline.files import read_log as read_log
from stereophd.pipeline.files import write_cameras as write_cameras
from stereophd.pipeline.files import write_log as write_log
from stereophd.pipeline.tracking.loop import Record as Record

__version__: str
