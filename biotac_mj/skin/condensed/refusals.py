"""Refuses settings that the condensed tier does not support, by name."""

from ..model import SkinOptions


def refuse(rubber: tuple[str, ...], options: SkinOptions, has_liquid: bool, on_cuda: bool) -> None:
    """Refuses settings of a skin that the condensed tier does not support.

    Args:
      rubber: effects of the material beyond its law, `Material.extensions`.
      options: SkinOptions. has_liquid: whether the skin is filled. on_cuda: whether it is on a CUDA device.

    Raises:
      ValueError: CUDA, inertia, rubber that remembers or stiffens, a contact law, or less liquid
        than the unstressed skin holds.
    """
    if on_cuda:
        raise ValueError("the condensed tier runs on the CPU: choose device='cpu', or the full tier on CUDA")
    if options.dynamics != "quasistatic":
        raise ValueError("the condensed tier has no inertia: choose dynamics='quasistatic' or the full tier")
    if rubber:
        raise ValueError(
            f"the condensed tier is elastic: leave {' and '.join(rubber)} out, or choose the full tier"
        )
    if options.contact_law is not None:
        raise ValueError(
            "the condensed tier knows Coulomb's law alone: leave contact_law out of SkinOptions, and "
            "adhesion, friction_exponent and friction_pressure out of worlds, or choose the full tier"
        )
    if has_liquid and (options.fill_volume < 0 or options.rest_pressure < 0):
        raise ValueError(
            "the condensed tier needs a skin clear of its core at rest: take fill_volume and "
            "rest_pressure >= 0, or the full tier"
        )
