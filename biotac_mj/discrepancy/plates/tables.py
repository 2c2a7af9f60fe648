"""Tables of answers of a flat press: the base model's, and those with each of the catalogue's effects that a
plate shows."""

from collections.abc import Sequence

from ...cache import cached
from ...effects.plate import PLATE, RADIUS, PlateEffect
from ...geometry.skin_geometry import SkinGeometry
from ...matching.response import Response, log_changes
from ...matching.states import PlateGrid, PlateStates, plate_states
from ...sensor.film import FilmConduction
from ...skin import Material

# Where effects that need states of their own have them: a change is smoother than what it changes.
_BASE = PlateGrid()
COARSER = PlateGrid(_BASE.pitch[::3] + _BASE.pitch[-1:], _BASE.roll[::3], _BASE.drag[-1:])


def base_response(geometry: SkinGeometry, quiet: bool = False) -> tuple[Response, PlateStates]:
    """The base model's answers, and its states."""
    states = plate_states(geometry, Material(), quiet=quiet)
    return Response(states, _readings(states, geometry, {})), states


def with_effects(
    response: Response,
    states: PlateStates,
    geometry: SkinGeometry,
    effects: Sequence[PlateEffect] = PLATE,
    quiet: bool = False,
) -> Response:
    """The base model's answers with a change for each effect, in their order."""
    coarser = states.on(COARSER)
    here = Response(coarser, _readings(coarser, geometry, {}))
    pairs = []
    for one in effects:
        skin = one.shape(geometry) if one.shape else geometry
        there = coarser
        if one.solved_anew:
            there = plate_states(skin, one.material or Material(), one.options, COARSER, quiet)
        film = one.film(skin.design) if one.film else {}
        pairs.append((here, Response(there, _readings(there, skin, film))))
    return response.with_changes(*pairs)


def _readings(states, geometry, film):
    """Change of ln Z in states of a skin, kept on disk: it takes as long as a fit."""
    settings = {"electrode_radius": RADIUS} | film

    def make():
        return {"log_z": log_changes(states, FilmConduction(geometry, sensor=None, **settings))}

    code = "geometry", "sensor", "matching"
    return cached("readings", [states, geometry, settings], make, code)["log_z"]
