"""Implicit dynamics: a vibrating bar, moving frames, momentum and damping."""

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from blocks import box, skin
from forces import energy_of

from biotac_mj.skin import GeomSet, Material, SkinData, SkinModel, SkinOptions, step

NOTHING = GeomSet([], [])
LENGTH, E, RHO = 50e-3, 1e6, 1000.0


def bar(law="linear", nu=0.0, cells=12, tolerance=1e-4, **options):
    """50 mm long, 10 mm wide, held at x = 0: free, along its axis it has the modes of a fixed-free bar, as nu
    = 0."""
    vert, elem = box([np.linspace(0, LENGTH, cells + 1), np.linspace(0, 1e-2, 3), np.linspace(0, 1e-2, 3)])
    options = SkinOptions(dynamics="implicit", tolerance=tolerance, max_newton=200, max_cg=200, **options)
    return SkinModel(
        skin(vert, elem, np.flatnonzero(vert[:, 0] == 0)), Material(law, E, nu, density=RHO), options
    )


def axial_mode(model):
    """Circular frequency [1/s] and shape (nvert,) of the lowest axial mode of the discrete bar."""
    mass = RHO * np.repeat(model.elements.node_volume[model.free], 3)
    K = model.stiffness
    shape = np.zeros((len(model.free), 3))
    shape[:, 0] = np.sin(np.pi * model.geometry.vert[model.free, 0] / 2 / LENGTH)
    values, vectors = spla.eigsh(K, k=12, M=sp.diags(mass).tocsc(), sigma=0)
    best = np.argmax(abs(vectors.T @ (mass * shape.ravel())))
    out = np.zeros((model.nvert, 3))
    out[model.free] = vectors[:, best].reshape(-1, 3)
    out *= np.sign(out[:, 0].sum()) / abs(out).max()
    return np.sqrt(values[best]), out


def swing(model, shape, dt, steps, amplitude=1e-4):
    """Lets go of a bar drawn into `shape`; amplitudes along the shape after each step."""
    data = SkinData(model)
    for array in (data.x, data.x_last):
        array.numpy()[:, 0] += amplitude * shape
    out = []
    weight = model.elements.node_volume[:, None] * shape
    for _ in range(steps):
        step(model, data, NOTHING, dt)
        assert data.converged.all()
        out.append(
            np.vdot(weight, data.vert_xpos[0] - model.geometry.vert) / np.vdot(weight, shape) / amplitude
        )
    return np.array(out), data


def test_frequency_of_the_bar():
    """omega = pi / 2 sqrt(E / rho) / L: the mesh and lumped masses miss it by about (pi / 2 / 12)^2 / 24."""
    omega, _ = axial_mode(bar())
    assert omega == pytest.approx(np.pi / 2 * np.sqrt(E / RHO) / LENGTH, rel=2e-3)


def test_backward_euler_is_of_first_order():
    model = bar()
    omega, shape = axial_mode(model)
    until = 1.0 / omega
    errors = []
    for steps in (16, 32, 64):
        amplitude, _ = swing(model, shape, until / steps, steps)
        errors.append(abs(amplitude[-1] - np.cos(1.0)))
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((0.9 < order) & (order < 1.1)).all(), (order, errors)


@pytest.mark.parametrize("mass_damping, stiffness_damping", [(0, 0), (300.0, 0), (0, 2e-4)])
def test_each_step_is_the_oscillators(mass_damping, stiffness_damping):
    """A mode is a scalar oscillator: backward Euler of x'' + (alpha + beta w^2) x' + w^2 x = 0, step by
    step."""
    model = bar(mass_damping=mass_damping, stiffness_damping=stiffness_damping)
    omega, shape = axial_mode(model)
    dt = 0.2 / omega
    amplitude, _ = swing(model, shape, dt, 12)
    x, v, expected = 1.0, 0.0, []
    damping = mass_damping + stiffness_damping * omega**2
    for _ in range(12):
        x_new = (x + dt * v + dt * damping * x) / (1 + dt * damping + dt**2 * omega**2)
        x, v = x_new, (x_new - x) / dt
        expected.append(x)
    np.testing.assert_allclose(
        amplitude, expected, atol=1e-5
    )  # of the amplitude; the solver's tolerance is absolute here


@pytest.mark.law
@pytest.mark.parametrize("law", ["corotational", "neo_hookean"])
def test_energy_falls(law):
    """Backward Euler never gains energy, and loses more when damped."""
    left = {}
    for damping in (0.0, 5e-4):
        model = bar(law, nu=0.3, cells=6, stiffness_damping=damping)
        data, along = SkinData(model), model.geometry.vert[:, 0]
        for array in (data.x, data.x_last):
            array.numpy()[:, 0] += np.stack([0.1 * along, 2.0 * along**2, 0 * along], 1)  # stretched and bent
        energies = []
        for _ in range(15):
            mass = RHO * model.elements.node_volume
            stored = energy_of(model.elements, data.rubber, data.options, data.x).sum()
            energies.append(stored + 0.5 * (mass[:, None] * data.velocity.numpy()[:, 0] ** 2).sum())
            step(model, data, NOTHING, 1e-3)
        assert (np.diff(energies) < 0).all()
        left[damping] = energies[-1] / energies[0]
    assert left[5e-4] < 0.8 * left[0.0]


def rotation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def test_uniform_motion_makes_no_force():
    """A finger that flies at constant speed and does not turn stays at rest in its own frame."""
    model = bar("corotational", nu=0.3)
    data, v, dt = SkinData(model), np.array([0.3, -0.2, 0.1]), 2e-3
    data.velocity.numpy()[:] = v
    turn = rotation(0.4)
    data.frame_mat_last.assign(turn[None])
    for k in range(1, 6):
        step(model, data, NOTHING, dt, (k * dt * v)[None], turn[None])
        assert data.converged.all()
    assert abs(data.vert_xpos[0] - model.geometry.vert).max() < 1e-12
    assert abs(data.reaction).max() < 1e-9
    np.testing.assert_allclose(data.velocity.numpy()[:, 0], np.broadcast_to(v, (model.nvert, 3)), atol=1e-9)


def test_acceleration_needs_its_force():
    """Held ends that accelerate drag the bar behind them: reaction = m a once the ringing is damped away."""
    model = bar(mass_damping=0.0, stiffness_damping=5e-3)
    data, a, dt = SkinData(model), np.array([1.0, 2.0, -0.5]), 2e-2
    turn = rotation(0.3)
    data.frame_mat_last.assign(turn[None])
    data.velocity.numpy()[:] = 0.0
    for k in range(1, 60):
        step(model, data, NOTHING, dt, (0.5 * a * (k * dt) ** 2)[None], turn[None])
        assert data.converged.all()
    np.testing.assert_allclose(
        turn @ data.reaction[0], RHO * LENGTH * 1e-4 * a, rtol=1e-4
    )  # the whole bar's mass


def test_momentum_balance_in_free_fall_of_the_nodes():
    """In every step the free nodes' momentum changes by what the held nodes and the loads push: reaction +
    load = d(m v) / dt."""
    model = bar("neo_hookean", nu=0.3, cells=6, tolerance=1e-7)
    data, dt = SkinData(model), 1e-3
    mass = RHO * model.elements.node_volume[model.free]  # the others do not move
    load = np.zeros((1, model.nvert, 3))
    load[0, :, 1] = -9.81 * RHO * model.elements.node_volume
    data.set_external(load)
    before = np.zeros(3)
    for _ in range(8):
        step(model, data, NOTHING, dt)
        now = (mass[:, None] * data.velocity.numpy()[model.free, 0]).sum(0)
        pushed = data.reaction[0] + load[0].sum(0)
        np.testing.assert_allclose((now - before) / dt, pushed, atol=1e-6 * abs(load[0].sum(0)).max())
        before = now


def test_dynamics_needs_a_time_step():
    model = bar(cells=2)
    for dt in (None, 0.0, -1e-3, float("nan")):
        with pytest.raises(ValueError, match="implicit dynamics needs the time step: pass dt > 0"):
            step(model, SkinData(model), NOTHING, dt)
