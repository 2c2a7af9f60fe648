"""The BioTac's geometry: skin meshes, rigid parts, electrodes, indenters, and the import of other meshes."""

from biotac_mj.geometry.assets import asset_path
from biotac_mj.geometry.indenters import INDENTERS, Indenter, indenter
from biotac_mj.geometry.making.importing import import_mesh
from biotac_mj.geometry.skin_geometry import SkinGeometry
from biotac_mj.geometry.skins import SKINS, load_skin
from biotac_mj.geometry.tet_mesh import TetMesh

__all__ = [
    "INDENTERS",
    "SKINS",
    "Indenter",
    "SkinGeometry",
    "TetMesh",
    "asset_path",
    "import_mesh",
    "indenter",
    "load_skin",
]
