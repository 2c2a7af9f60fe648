"""Gradients of temperatures and of what TDC and TAC read: the values of `sensor.heat`, slopes as differences
tell them."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from gradients import differences

from biotac_mj.differentiable import tac_counts, tdc_counts, temperatures
from biotac_mj.sensor.channels import counts_from_temperature, heating_exponent, thermistor_counts
from biotac_mj.sensor.heat import ABOVE, BODIES, MADE, THERMISTOR, Heat, HeatParameters, begin_heat
from biotac_mj.sensor.materials import material_of

BODIES_OF = [material_of("steel"), material_of("cork")]
DT = 0.5


def touches(count=40):
    """Areas (count, 2) [m^2] and forces [N] of two bodies that come, grow, shrink, part and come again."""
    t = np.linspace(0, 1, count)[:, None]
    wave = np.sin(2 * np.pi * (t * [1.7, 1.1] + [0.05, 0.4]))
    return np.maximum(4e-5 * wave, 0), np.maximum(3 * wave, 0)


def begin():
    return begin_heat(31.0, 0.4, bodies=BODIES_OF)


def test_temperatures_are_those_of_the_sensor():
    area, force = touches()
    for scale in (1.0, 30.0):  # the latter fill the pad
        heat, other = Heat(BODIES_OF, HeatParameters(air=20.0)), []
        heat.state.assign(begin()[None])
        for a, f in zip(scale * area, force):
            heat.area.assign(a[None])
            heat.force.assign(f[None])
            heat.advance(DT)
            other.append(heat.state.numpy()[0].copy())
        found = temperatures(scale * area, force, DT, begin(), {"air": 20.0}).numpy()
        assert np.allclose(found, other, rtol=1e-10, atol=1e-15)


def test_slopes_of_temperatures_are_differences():
    """By areas, forces, the state that it begins at with its bodies, and every constant, of what TDC and TAC
    read."""
    area, force = touches(14)
    draw = np.random.default_rng(0)
    area = area + 1e-7 * (area > 0)
    given = {"area": area, "force": force, "begin": begin()}
    given |= {f"sensor's {k}": v for k, v in dataclasses.asdict(HeatParameters()).items() if k != "power"}
    given = {k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in given.items()}
    weight = torch.tensor(draw.normal(size=len(area)))

    def felt(**changed):
        own = given | changed
        constants = {k.removeprefix("sensor's "): v for k, v in own.items() if k.startswith("sensor's ")}
        state = temperatures(own["area"], own["force"], DT, own["begin"], constants)
        warm = state[:, THERMISTOR]
        rate = (warm[1:] - warm[:-1]) / DT
        counts = (weight * tdc_counts(warm)).sum() + 0.1 * (weight[1:] * tac_counts(rate)).sum()
        return counts + (weight * state[:, ABOVE]).sum()

    slopes = dict(zip(given, torch.autograd.grad(felt(), list(given.values()))))
    draws = {name: torch.tensor(draw.uniform(0.5, 1, value.shape)) for name, value in given.items()}
    ways = {name: value.detach() * draws[name] for name, value in given.items()}
    # areas move together: no body ceases to grow on one side of a difference alone
    ways["area"] = given["area"].detach().clone()

    def moved(h, name):
        with torch.no_grad():
            return felt(**{name: given[name] + h * ways[name]}).item()

    for name, way in ways.items():
        assert slopes[name].abs().max() > 0, name
        found = differences(functools.partial(moved, name=name), 4e-3)
        assert found == pytest.approx((slopes[name] * way).sum().item(), rel=1e-6), name


def test_counts_are_those_of_the_channels():
    warm, rate = np.linspace(5, 60, 12), np.linspace(-1, 4, 12)
    assert tdc_counts(warm).numpy() == pytest.approx(counts_from_temperature(warm), rel=1e-14)
    assert tac_counts(rate).numpy() == pytest.approx(thermistor_counts(heating_exponent(rate)), rel=1e-14)


def test_what_a_body_is_of_has_a_slope():
    """A contact tells materials apart: TDC falls further on what takes more heat."""
    area, force = touches()
    state = torch.tensor(begin(), requires_grad=True)
    warm = temperatures(area, force, DT, state)[-1, THERMISTOR]
    slope = torch.autograd.grad(warm, state)[0]
    assert slope[BODIES + MADE] < 0


@pytest.mark.parametrize(
    "change, said",
    [
        ({"area": np.zeros((3, 1))}, r"pass \(nstep, nbody\) of both"),
        ({"begin": np.zeros(4)}, r"begin has shape \(4,\): 2 bodies make it"),
        ({"dt": 0.0}, r"dt is 0.0: give a finite number > 0 \[s\]"),
        ({"area": np.full((3, 2), -1e-6)}, "area is negative or no number somewhere: give square metres"),
        ({"force": np.full((3, 2), np.nan)}, "force is negative or no number somewhere: give newtons"),
        ({"area": np.full((3, 2), 1e-6j)}, "area is of complex128: give real numbers"),
        ({"constants": {"power": 1.0}}, "constants has .power.: choose from ambient"),
        ({"constants": {"air": -1.0}}, "air cannot be"),
    ],
)
def test_what_cannot_be_is_named(change, said):
    area, force = touches(3)
    given = {"area": area, "force": force, "dt": DT, "begin": begin()}
    with pytest.raises(ValueError, match=said):
        temperatures(**given | change)
