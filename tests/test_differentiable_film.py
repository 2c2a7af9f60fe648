"""The film's and the counts' gradients: the same values as `sensor` has, slopes as differences tell them."""

import dataclasses

import numpy as np
import pytest
import torch

from biotac_mj.differentiable import electrode_counts, impedance, pdc_counts
from biotac_mj.effects.in_film import RoughFilm
from biotac_mj.geometry import load_skin
from biotac_mj.sensor.film import FilmConduction, NoFilmError
from biotac_mj.sensor.presets import SENSORS, Sensor
from biotac_mj.sensor.readings import PhysicsReadings


@pytest.fixture(scope="module")
def film():
    return FilmConduction(load_skin("coarse"))


@pytest.fixture(scope="module")
def pressed(film):
    """A dent over the pad, deep enough that the film is at its least somewhere."""
    vert = film.geometry.vert
    way = np.linalg.norm(vert - [-0.010, -0.007, 0.001], axis=1)
    dent = 0.9e-3 * np.exp(-((way / 3e-3) ** 2))
    free = np.ones(len(vert))
    free[film.geometry.fixed] = 0
    return vert + (dent * free)[:, None] * [0.1, 1.0, -0.2]


def test_impedances_are_those_of_the_film(film, pressed):
    for nodes in (film.geometry.vert, pressed):
        expected = film.impedance(nodes)
        assert impedance(film, torch.from_numpy(nodes)).numpy() == pytest.approx(expected, rel=1e-9)


def test_slopes_of_impedances_are_differences(film, pressed):
    """By the nodes and by the sensor's constants."""
    draw = np.random.default_rng(0)
    given = {
        "nodes": pressed, "conductivity": film.conductivity, "electrode_radius": film.electrode_radius,
        "residual_film": film.residual_film, "cell_constant": film.cell_constant,
        "rest_nodes": film.geometry.vert,
    }  # fmt: skip
    given = {name: torch.tensor(value, dtype=torch.float64) for name, value in given.items()}
    weight = torch.tensor(draw.normal(size=19) * 1e-3)

    def total(**changed):
        own = given | changed
        del own["rest_nodes" if "rest_nodes" not in changed else "cell_constant"]
        return impedance(film, **own) @ weight

    for name, size in (
        ("nodes", 1e-9), ("conductivity", 1e-4), ("electrode_radius", 1e-8), ("residual_film", 1e-9),
        ("cell_constant", 1e-4), ("rest_nodes", 1e-9),
    ):  # fmt: skip
        value = given[name].clone().requires_grad_()
        total(**{name: value}).backward()
        way = torch.tensor(draw.normal(size=value.shape))
        if "nodes" not in name:
            way = value.detach() / value.detach().abs().max()
        with torch.no_grad():
            ahead, back = (total(**{name: value + h * way}).item() for h in (size, -size))
        assert value.grad.abs().max() > 0, name
        assert (ahead - back) / (2 * size) == pytest.approx((value.grad * way).sum().item(), rel=2e-6), name


def test_a_shape_is_another_sensor(film, pressed):
    """Rest positions calibrate a film as one that is made of them is, also a rough one."""
    vert = film.geometry.vert.copy()
    vert[:, 1] += 3e-5 * np.sin(600 * vert[:, 0]) * ~np.isin(np.arange(len(vert)), film.geometry.fixed)
    made = FilmConduction(dataclasses.replace(film.geometry, vert=vert))
    for power in (1.0, 0.8):
        own, other = (RoughFilm(each, power) for each in (film, made))
        expected = other.impedance(pressed)
        assert np.abs(own.impedance(pressed) / expected - 1).max() > 1e-3
        found = impedance(own, torch.from_numpy(pressed), rest_nodes=torch.from_numpy(vert))
        assert found.numpy() == pytest.approx(expected, rel=1e-9)
    with pytest.raises(ValueError, match="cell_constant follows from rest_nodes"):
        impedance(
            film, torch.from_numpy(vert), cell_constant=torch.ones(19), rest_nodes=torch.from_numpy(vert)
        )


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda x: x[:-1], "has shape .*: pass"),
        (lambda x: x[None], "has shape .*: pass"),
        (lambda x: x * np.nan, "is not finite under the film"),
        (lambda x: "nodes", "give real numbers"),
    ],
    ids=["one less", "two skins", "nan", "text"],
)
def test_nodes_of_another_skin_are_refused(film, make, message):
    vert = film.geometry.vert
    with pytest.raises(ValueError, match=f"^rest_nodes .*{message}"):
        impedance(film, torch.from_numpy(vert), rest_nodes=make(vert))
    with pytest.raises(ValueError, match=f"^nodes .*{message}"):
        impedance(film, make(vert))
    assert impedance(film, vert.astype(np.float32)).dtype == torch.float64


@pytest.mark.parametrize(
    "sensor",
    [
        SENSORS["1"],
        Sensor(pdc_gain=1.2, power=0.8, saturation=(0.5, 100.0), mixing=tuple(map(tuple, 0.9 * np.eye(19)))),
    ],
    ids=["1", "worn"],
)
def test_counts_are_those_of_the_acquisition(film, pressed, sensor):
    """To half a count, by which it rounds."""
    readings = PhysicsReadings(film.geometry, noise=False, sensor=sensor, film=film)
    state = np.zeros(readings.nstate)
    readings.reset(state)
    for k in range(30):
        readings.advance(state, 0.01 * k, 0.01, pressed, 3e3)
    expected = readings.readings(state)
    found = electrode_counts(impedance(film, torch.from_numpy(pressed)), film.rest, sensor)
    assert np.abs(found.numpy() - expected["electrodes"]).max() <= 0.5 + 1e-6
    assert abs(pdc_counts(torch.tensor(3e3), sensor).item() - expected["pdc"]) <= 0.5 + 1e-6
    moved = impedance(film, torch.from_numpy(pressed)).requires_grad_()
    electrode_counts(moved, film.rest, sensor).sum().backward()
    assert (moved.grad < 0).all()  # more liquid, lower impedance, higher counts


def test_an_electrode_without_film_is_refused(film):
    with pytest.raises(NoFilmError, match="no liquid film over disc"):
        impedance(film, torch.from_numpy(film.geometry.vert) + torch.tensor([0.1, 0, 0]))
