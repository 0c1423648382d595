"""The public names of stereophd, listed once: type checkers read this file, and so does ``__init__.py``."""

from stereophd.api import Outputs as Outputs
from stereophd.api import align as align
from stereophd.api import calibrate as calibrate
from stereophd.api import check as check
from stereophd.api import evaluate as evaluate
from stereophd.api import evaluate_cameras as evaluate_cameras
from stereophd.api import experiment as experiment
from stereophd.api import export as export
from stereophd.api import import_recording as import_recording
from stereophd.api import init as init
from stereophd.api import report_page as report_page
from stereophd.api import simulate as simulate
from stereophd.api import track as track
from stereophd.commands.demo import demo as demo
from stereophd.commands.info import info as info
from stereophd.config.loading import LoadedConfig as LoadedConfig
from stereophd.config.loading import load_config as load_config
from stereophd.config.loading import make_config as make_config
from stereophd.core.geometry.camera import Camera as Camera
from stereophd.core.geometry.camera import Clock as Clock
from stereophd.core.geometry.camera import Detector as Detector
from stereophd.core.geometry.lens import Lens as Lens
from stereophd.core.geometry.pose import Pose as Pose
from stereophd.errors import GateError as GateError
from stereophd.errors import InputError as InputError
from stereophd.errors import StereophdError as StereophdError
from stereophd.io.logs.reading import Frame as Frame
from stereophd.pipeline.array_filters import ArrayFilter as ArrayFilter
from stereophd.pipeline.array_filters import make_filter as make_filter
from stereophd.pipeline.files import read_cameras as read_cameras
from stereophd.pipeline.files import read_log as read_log
from stereophd.pipeline.files import write_cameras as write_cameras
from stereophd.pipeline.files import write_log as write_log
from stereophd.pipeline.tracking.loop import Record as Record

__version__: str
