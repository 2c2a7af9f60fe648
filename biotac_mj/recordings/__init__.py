"""Recordings of real BioTacs: one format, importers, inspection, a picture, live recording."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .formats.bags import write_bag as write_bag
    from .importers import Loaded as Loaded
    from .importers import load as load
    from .importers import load_one as load_one
    from .inspection import faults as faults
    from .inspection import findings as findings
    from .inspection import warnings as warnings
    from .picture import draw as draw
    from .recording import FIELDS as FIELDS
    from .recording import SCHEMA as SCHEMA
    from .recording import Recording as Recording
    from .recording import read as read
    from .recording import write as write
    from .simulated import of_simulation as of_simulation

__getattr__, __dir__ = lazy(__name__)
