"""Kernel launches that remember their arguments: packing them takes Warp longer than many of the kernels
run."""

import warp as wp

__all__ = ["Launches"]

_MOST = 64  # remembered launches: those of a few skins


class Launches:
    """Launches kernels on one device. A launch whose arguments are those of an earlier one, the same objects,
    is not packed again.

    What the arrays hold may change between launches; a struct must keep its arrays.
    """

    def __init__(self, device):
        self._device, self._known = device, {}

    def __call__(self, kernel, dim, inputs, outputs):
        arguments = (*inputs, *outputs)
        key = (kernel, dim, *[a if isinstance(a, (int, float)) else id(a) for a in arguments])
        known = self._known.get(key)
        if known is None:
            if len(self._known) == _MOST:
                self._known.clear()
            command = wp.launch(
                kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device, record_cmd=True
            )
            self._known[key] = known = (
                command,
                arguments,
            )  # kept, so that no other object takes their place in memory
        known[0].launch()
