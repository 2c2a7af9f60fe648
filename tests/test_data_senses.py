"""Sets and presses whose sensors differ, with heat, vibration and all samples of PAC."""

import dataclasses
import json

import numpy as np
import pytest
from blocks import four_nodes

from biotac_mj import cli
from biotac_mj.data import SPLITS, TactileSet
from biotac_mj.data.generation.generate import GenerateOptions, generate
from biotac_mj.data.generation.readings import in_order
from biotac_mj.data.lerobot import export_lerobot
from biotac_mj.press import PressOptions, press
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.acquisition_kernels import SLOT_RATE
from biotac_mj.sensor.channels import CHANNELS, NELECTRODE
from biotac_mj.sensor.presets import SENSORS

PAC, TDC, TAC = (CHANNELS.index(name) for name in ("pac", "tdc", "tac"))
PLAIN = GenerateOptions(
    count=2, labelled=0, steps=16, rate=25.0, seed=4, objects=("cube_14mm",), kinds=("slide",), skin="coarse",
    material={"friction": 0.1},
)  # fmt: skip
HOT = "steel at 400"  # so that it tells within a second
FELT = dataclasses.replace(
    PLAIN,
    sensor="random",
    randomise=("dead", "crosstalk"),
    thermal=(HOT, "foam"),
    texture={"roughness": 4e-5},
)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    out = tmp_path_factory.mktemp("sets")
    four_nodes("coarse").save(out / "skin.npz")  # a quarter of the work
    for name, options in (("plain", PLAIN), ("felt", FELT)):
        options = dataclasses.replace(options, skin=str(out / "skin.npz"))
        generate(out / name, options, workers=0, progress=False)
    return out


def test_sensors_of_a_set_differ_and_are_kept(sets):
    with TactileSet(sets / "felt") as data, TactileSet(sets / "plain") as plain:
        rest = [data.parameters(i)["sensor"]["rest"] for i in range(2)]
        assert rest[0] != rest[1] and {data.parameters(i)["thermal"] for i in range(2)} <= {HOT, "foam"}
        for i in range(2):
            row = data["counts"][data.start[i]]
            np.testing.assert_allclose(row[:NELECTRODE], rest[i], atol=35)
            assert abs(row[TDC] - data.parameters(i)["sensor"]["tdc_rest"]) < 3
            assert "sensor" not in plain.parameters(i)
            np.testing.assert_allclose(
                plain["counts"][plain.start[i]][:NELECTRODE], SENSORS["1"].rest, atol=35
            )


def test_a_set_keeps_all_samples_of_pac(sets, tmp_path):
    with TactileSet(sets / "felt") as data, TactileSet(sets / "plain") as plain:
        for one in (data, plain):
            pac = one["pac"][:]
            assert pac.shape == (32, 22) and (pac[:, -1] == one["counts"][:][:, PAC]).all()
        fine = [np.abs(np.diff(s["pac"][:].astype(float), axis=1)).mean() for s in (plain, data)]
        assert fine[1] > 2 * fine[0] > SENSORS["1"].pac_noise  # slides over something rough
        parquet = pytest.importorskip(
            "pyarrow.parquet", reason="needs pyarrow: pip install 'biotac-mj[lerobot]'"
        )
        out = export_lerobot(data, tmp_path / "lerobot", progress=False)
        table = parquet.read_table(next(out.glob("data/*/*.parquet")))
        exported = np.array(table["observation.tactile.pac"].to_pylist())
        # episodes come split by split
        order = np.concatenate([np.flatnonzero(data.split == name) for name in SPLITS])
        rows = np.concatenate([np.arange(data.start[i], data.stop[i]) for i in order])
        np.testing.assert_array_equal(exported, data["pac"][:][rows])
        info = json.loads((out / "meta/info.json").read_text())
        assert info["features"]["observation.tactile.pac"]["shape"] == [22]


def test_heat_moves_tac_and_only_where_it_is(sets):
    def moved(data, i):
        rows = data["counts"][data.start[i] : data.stop[i]]
        return np.ptp(rows[:, TAC])

    with TactileSet(sets / "felt") as data, TactileSet(sets / "plain") as plain:
        assert max(moved(plain, i) for i in range(2)) < 6  # noise
        steel = [i for i in range(2) if data.parameters(i)["thermal"] == HOT]
        assert all(moved(data, i) > 12 for i in steel) and steel


def test_order_of_the_samples():
    """A ramp in PAC's slots: in order of time whatever the moment."""
    acquisition, rest = Acquisition(noise=False), SENSORS["1"].impedance
    state, time = np.zeros(acquisition.nstate), 0.0
    acquisition.reset(state, rest)
    for dt in (0.013, 0.01, 0.0213):
        acquisition.advance(state, time, dt, rest, 1e6 * (time + dt))
        time += dt
        last = (np.floor(time * SLOT_RATE + 1e-6) - 1) // 2
        pac = in_order(np.arange(22), time)
        assert pac[-1] == last % 22 and (np.diff(pac) % 22 == 1).all()


def test_a_press_has_the_sensor_and_feels_what_it_touches():
    options = dict(depth=1e-3, skin="coarse", tier="condensed", hold=0.5, timestep=1e-2)
    plain = press(PressOptions(**options), progress=False)[0]
    felt = press(PressOptions(**options, sensor="phac_f0", thermal=HOT), progress=False)[0]
    np.testing.assert_allclose(felt.counts[0, :NELECTRODE], SENSORS["phac_f0"].rest, atol=3)
    assert np.ptp(felt.counts[:, TAC]) > 8 > np.ptp(plain.counts[:, TAC])


def test_command_lines_say_it():
    args = cli.parser().parse_args(
        ["press", "--sensor", '{"like": "epfl_f1", "drift": 3}', "--thermal", "steel", "--randomise", "dead"]
    )
    assert args.sensor == {"like": "epfl_f1", "drift": 3} and args.thermal == "steel"
    args = cli.parser().parse_args(["data", "generate", "--sensor", "random", "--texture", "cork", "carpet"])
    assert args.sensor == "random" and args.texture == ["cork", "carpet"]


@pytest.mark.parametrize("kind", [PressOptions, GenerateOptions])
def test_a_texture_has_the_name_that_attach_gives_it_too(kind):
    both = kind(texture="cork"), kind(textures="cork"), kind(texture="cork", textures="cork")
    assert len(set(map(repr, both))) == 1 and both[1].texture == "cork"
    assert dataclasses.replace(both[1], seed=3).texture == "cork"
    with pytest.raises(ValueError, match="texture is 'cork' and textures has 'steel': give one of them"):
        kind(texture="cork", textures="steel")
    args = cli.parser().parse_args(["press", "--textures", "cork"])
    assert args.texture == "cork"


def test_what_cannot_be_is_refused(tmp_path):
    with pytest.raises(ValueError, match="sensor is 'f9'"):
        GenerateOptions(sensor="f9")
    with pytest.raises(ValueError, match="no material is known by 'mithril'"):
        GenerateOptions(thermal=("steel", "mithril"))
    condensed = dataclasses.replace(PLAIN, tier="condensed", texture="cork")
    with pytest.raises(ValueError, match="condensed tier know no vibration"):
        generate(tmp_path / "set", condensed, workers=0, progress=False)
