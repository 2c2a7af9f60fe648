"""Data sets of tactile interactions: schema, HDF5 store, splits, generation, importers, export."""

import typing

from ..lazy import lazy

if typing.TYPE_CHECKING:
    from .generation.generate import GenerateOptions as GenerateOptions
    from .generation.generate import GenerateReport as GenerateReport
    from .generation.generate import generate as generate
    from .lerobot import export_lerobot as export_lerobot
    from .schema import COLUMNS as COLUMNS
    from .schema import KINDS as KINDS
    from .schema import SCHEMA as SCHEMA
    from .schema import SPLITS as SPLITS
    from .schema import Interaction as Interaction
    from .schema import nodes_of as nodes_of
    from .splits import FRACTIONS as FRACTIONS
    from .splits import Split as Split
    from .splits import split_by_interaction as split_by_interaction
    from .splits import split_by_object as split_by_object
    from .store import TactileSet as TactileSet
    from .store import shard_path as shard_path
    from .store import write_shard as write_shard
    from .trajectories import export_mujoco as export_mujoco

__getattr__, __dir__ = lazy(__name__)
