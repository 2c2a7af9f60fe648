"""Fingertips as a family: what a design is, and that the code has no number of electrodes of its own."""

import ast
import json

import numpy as np
import pytest
from imports import modules

from biotac_mj.geometry.design import BIOTAC, DESIGNS, Design, design_of_channels, read_design

# numbers that are 19 for another reason: a seed, bits that hands have taken
OTHERS = {"data.generation.synthetic_sensor", "tasks.in_hand.bank"}


def test_the_code_has_no_nineteen_of_its_own():
    found = [
        f"{name}, line {node.lineno}"
        for name, path in modules().items()
        if name.removeprefix("biotac_mj.") not in OTHERS
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and type(node.value) is int and node.value == 19
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", DESIGNS)
def test_a_design_is_the_same_after_its_text(name):
    design = read_design(name)
    assert read_design(design.text) == design and design.name == name
    assert design_of_channels(design.nelectrode) == design
    assert len(design.channels) == design.nelectrode + 4 and design.slots >= 2 * (design.nelectrode + 3)


@pytest.mark.parametrize("name", DESIGNS)
def test_the_mirror_turns_z_of_every_electrode(name):
    design = read_design(name)
    place = design.in_biotac_frame(np.array(design.electrodes_mm))
    np.testing.assert_allclose(place[design.mirror], place * [1, 1, -1], atol=1e-12)
    np.testing.assert_array_equal(design.mirror[design.mirror], np.arange(design.nelectrode))


def test_what_cannot_be_simulated_is_said():
    places = np.random.default_rng(0).normal(size=(31, 3)).tolist()
    for changes, said in (
        ({"electrodes_mm": places, "excitation": places[:2]}, "31 electrodes and 2 of excitation: at most 4"),
        ({"electrodes_mm": places[:6]}, "6 electrodes and 0 of excitation: give both, or neither"),
        ({"electrodes_mm": [[1, 2]], "excitation": [[0, 0, 0]]}, "give rows of 3 finite numbers"),
        ({"slots": 5}, "slots of design 'mine' are 5"),
        ({"electrodes_mm": places[:6], "excitation": places[:1]}, "no sensor ''"),
        ({"sensors": {"a": {"rest": [1.0]}}}, "sensor 'a' of design 'mine' needs 0 rest counts"),
    ):
        with pytest.raises(ValueError, match=said):
            Design("mine", "my pad", **changes)
    with pytest.raises(ValueError, match="a design has no 'colour'"):
        read_design(json.dumps({"name": "a", "title": "b", "colour": "red"}))
    with pytest.raises(FileNotFoundError, match="pass one of biotac, biotac_sp, or a folder"):
        read_design("nowhere")
    assert BIOTAC.nelectrode + 5 == read_design("biotac_sp").nelectrode
