"""Film and acquisition together, on the project's skin and on stored deformations of the published mesh."""

import pathlib

import numpy as np
import pytest

from biotac_mj.sensor import channels
from biotac_mj.sensor.acquisition_kernels import SLOT_RATE
from biotac_mj.sensor.film import FilmConduction, NoFilmError
from biotac_mj.sensor.readings import PhysicsReadings

REFERENCE = pathlib.Path(__file__).resolve().parents[1] / "../shared/reference"
MESH = REFERENCE / "../data/nvlabs_biotac_sim"
E17 = 16


@pytest.fixture(scope="module")
def geometry():
    from biotac_mj.geometry import load_skin

    return load_skin("default")


@pytest.fixture(scope="module")
def film(geometry):
    return FilmConduction(geometry)


def indented(film, depth, conserve):
    """A synthetic motion: a Gaussian dent of `depth` [m] over E17, 2 mm wide, along the core's normal.

    With conserve=1 the displaced volume is spread evenly over the film, as an incompressible liquid would;
    with 0 the shell bulges nowhere."""
    geometry = film.geometry
    rest = geometry.vert[film.node]
    distance, foot, _ = film.core.closest(rest)
    clear = distance > 0.1e-3
    normal = np.where(clear[:, None], rest - foot, 0) / np.where(clear, distance, 1)[:, None]
    dent = np.exp(-((rest - geometry.electrode_pos[E17]) ** 2).sum(1) / (2 * 2e-3**2)) * clear
    corner = rest[film.face]
    area = np.zeros(len(rest))
    np.add.at(
        area,
        film.face,
        np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)[:, None]
        / 6,
    )
    lift = conserve * (area * dent).sum() / (area * clear).sum()
    vert = geometry.vert.copy()
    vert[film.node] += depth * ((lift - dent) * clear)[:, None] * normal
    return vert


def test_pressing_raises_the_contact_and_lowers_the_bulge(film):
    rest = film.impedance(film.geometry.vert)
    change = np.log(film.impedance(indented(film, 1.4e-3, conserve=1.0)) / rest)
    assert np.argmax(change) == E17 and change[E17] > 0.15
    # E1 E4 E6 and their mirror images: thin film on the flanks, far from the dent
    away = [0, 3, 5, 10, 13, 15]
    assert np.all(change[away] < -0.02)
    dry = np.log(film.impedance(indented(film, 1.4e-3, conserve=0.0)) / rest)
    assert np.all(change < dry)


def test_readings_follow_a_press(geometry, film):
    physics = PhysicsReadings(geometry, noise=False, film=film)
    time = np.arange(0, 0.1001, 0.01)
    depth = np.linspace(0, 0.8e-3, len(time))
    vert, pressure = [indented(film, d, 1.0) for d in depth], 5e3 * depth / depth[-1]
    state = np.zeros(physics.nstate)
    physics.reset(state, vert[0], pressure[0], time[0])
    each = [physics.readings(state)]
    for i, dt in enumerate(np.diff(time)):
        physics.advance(state, time[i], dt, vert[i + 1], pressure[i + 1])
        each.append(physics.readings(state))
    rows = {name: np.stack([one[name] for one in each]) for name in each[0]}
    assert rows["electrodes"].shape == (11, 19) and rows["pac"].shape == (11, 22)
    assert np.array_equal(rows["electrodes"][0], channels.REST_COUNTS["1"])
    assert np.all(np.diff(rows["electrodes"][1:, E17]) < 0)
    # PDC's last slot, less the low-pass filter's delay on a ramp
    last = 0.09 + 40 / SLOT_RATE - 1 / (2 * np.pi * 1040)
    assert channels.pressure_from_counts(rows["pdc"][-1]) == pytest.approx(5e3 * last / 0.1, abs=20)
    assert np.all(rows["tdc"] == rows["tdc"][0])


def test_left_electrodes_read_as_right_ones_at_rest(film):
    """The skin is symmetric in z and so are the excitation electrodes: without calibration E1..E6 equal
    E11..E16 within the mesh."""
    free = FilmConduction(film.geometry, sensor=None)
    impedance = free.impedance(film.geometry.vert)
    np.testing.assert_allclose(impedance[:6], impedance[10:16], rtol=0.06)


def test_physics_explains_the_rest_pattern(film):
    """ln Z of the uncalibrated film against the mean of the published sensors, which among themselves
    correlate 0.69-0.91."""
    published = np.mean(
        [np.log(channels.impedance_from_counts(c)) for c in channels.REST_COUNTS.values()], axis=0
    )
    impedance = FilmConduction(film.geometry, sensor=None).impedance(film.geometry.vert)
    assert np.corrcoef(np.log(impedance), published)[0, 1] > 0.9


def test_film_is_solved_once_per_frame(geometry, film, monkeypatch):
    calls = []
    monkeypatch.setattr(film, "impedance", lambda vert, solve=film.impedance: calls.append(1) or solve(vert))
    moved = geometry.vert + [0.0, 1e-6, 0.0]
    # a skin at rest is known: it is not solved at all
    for every, vert, expected in ((False, moved, 2), (True, moved, 10), (True, geometry.vert, 0)):
        physics = PhysicsReadings(geometry, film=film, film_every_step=every)
        state = np.zeros(physics.nstate)
        physics.reset(state)
        calls.clear()
        for i in range(10):
            physics.advance(state, i * 2e-3, 2e-3, vert, 0.0)
        assert len(calls) == expected


def test_motion_that_is_not_finite_changes_no_state(geometry, film):
    physics = PhysicsReadings(geometry, film=film)
    state = np.zeros(physics.nstate)
    physics.reset(state)
    before = state.copy()
    with pytest.raises(ValueError, match="not finite"):
        physics.advance(state, 0.0, 1e-2, np.full_like(geometry.vert, np.nan), 0.0)
    assert np.array_equal(before, state)


@pytest.mark.skipif(not REFERENCE.exists(), reason="stored deformations (../shared/reference) are not here")
@pytest.mark.parametrize(
    "case, electrode",
    [
        ("A_sphere3.5_pad_core", 17),
        pytest.param("B_cube_pad", 17, marks=pytest.mark.slow),
        pytest.param("B_sphere7_tip", 7, marks=pytest.mark.slow),
    ],
)
def test_stored_deformations_raise_the_pressed_electrode(case, electrode):
    """Reference fields of the published mesh, made without liquid."""
    from biotac_mj.geometry import import_mesh

    skin = import_mesh(MESH)
    film = FilmConduction(skin)
    with np.load(REFERENCE / f"{case}.npz") as stored:
        last = stored["displacement"][-1]
    change = np.log(film.impedance(skin.vert + last) / film.impedance(skin.vert))
    assert np.argmax(change) == electrode - 1 and change[electrode - 1] > 0.1


def test_without_a_film_electrodes_hold(geometry, film):
    """Of a skin that a blow has lifted off its core; the other channels go on."""
    away = geometry.vert.copy()
    away[film.node] += 4e-3 * np.array([0.0, -1.0, 0.0])
    with pytest.raises(NoFilmError):
        film.impedance(away)
    readings = PhysicsReadings(geometry, film=film, noise=False)
    state = np.zeros(readings.nstate)
    readings.reset(state)
    rest = readings.readings(state)
    for k in range(20):
        readings.advance(state, k * 2e-3, 2e-3, away, 5e3)
    now = readings.readings(state)
    np.testing.assert_array_equal(now["electrodes"], rest["electrodes"])
    assert (np.asarray(now["pdc"]) > np.asarray(rest["pdc"])).all()
