"""Data sets of tactile interactions: schema, HDF5 store, splits, generation, importers, export."""

from .schema import COLUMNS, KINDS, SCHEMA, SPLITS, Interaction, nodes_of
from .splits import FRACTIONS, Split, split_by_interaction, split_by_object
from .store import TactileSet, shard_path, write_shard

__all__ = [
    "COLUMNS",
    "FRACTIONS",
    "KINDS",
    "SCHEMA",
    "SPLITS",
    "Interaction",
    "Split",
    "TactileSet",
    "nodes_of",
    "shard_path",
    "split_by_interaction",
    "split_by_object",
    "write_shard",
]
