"""How kernels are compiled."""

import pathlib
import re

import pytest
import warp as wp

from biotac_mj import kernels
from biotac_mj.kernels import kernel_module

PACKAGE = pathlib.Path(__file__).parent.parent / "biotac_mj"


@pytest.mark.parametrize(
    "flags, kept",
    [
        (kernels._WARP, "-march=native"),
        ("", ""),
        (None, None),
        ("-march=x86-64-v3 -mllvm=-inline-threshold=9000 -fno-vectorize", "-march=x86-64-v3 -fno-vectorize"),
    ],
)
def test_a_kernel_module_inlines_by_llvm_s_own_limits(monkeypatch, flags, kept):
    monkeypatch.setattr(kernels, "_WARP", flags)
    name = kernel_module("test_kernels.flags")
    options = wp.get_module_options(name)
    assert name == "test_kernels.flags"
    assert options["cpu_compiler_flags"] == kept and options["enable_backward"] is False
    inlined = wp.get_module_options(kernel_module(name, inlined=True))["cpu_compiler_flags"]
    assert ("-inline-threshold=9000" in (inlined or "")) == ("-inline-threshold=9000" in (flags or ""))


def test_every_kernel_is_in_a_module_with_the_options():
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text()
        kernels = re.findall(r"wp\.kernel\b(?:\((.*)\))?", text)
        own = [given for given in kernels if not re.search(r"\bmodule=|\*\*", given)]
        assert not own or "\nkernel_module(__name__)\n" in text, path
        assert not re.search(r'module=f?"(?!unique")', text), path
