"""Finds where simulation and measurement disagree, names the missing effect, adds it, and shows that the gap
shrinks."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from ..effects.catalogue import CATALOGUE as CATALOGUE
    from ..effects.effect import Effect as Effect
    from ..effects.effect import Param as Param
    from .recordings.recording import PlainRecording as PlainRecording
    from .recordings.recording import read_recording as read_recording
    from .recordings.search import diagnose_recording as diagnose_recording
    from .report.verdict import Finding as Finding
    from .report.verdict import Verdict as Verdict
    from .trajectories.model.sensor_file import load_simulator as load_simulator
    from .trajectories.model.simulator import Simulator as Simulator
    from .trajectories.trajectory import Trajectory as Trajectory
    from .trajectories.trajectory import read_trajectories as read_trajectories
    from .trajectories.trajectory import write_trajectories as write_trajectories
    from .trajectories.workflow import TrajectoryDiagnosis as TrajectoryDiagnosis
    from .trajectories.workflow import diagnose as diagnose

__getattr__, __dir__ = lazy(__name__)
