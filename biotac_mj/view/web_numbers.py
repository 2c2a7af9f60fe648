"""Numbers of the electrodes on the page: each browser shows those that face its camera and do not overlap."""

import contextlib
import threading

import numpy as np

from ..geometry.rigid import matrix

__all__ = ["Numbers", "legible"]

_HEIGHT = 1e-3  # [m] of the letters
_ROOM = 2e-3  # [m] between two numbers: as wide as the box of one with two digits
_ABOVE = 8e-4  # [m] height of a number above the core
_FACING = 0.25  # least cosine between normal and line of sight


def legible(eye: np.ndarray, pos: np.ndarray, normal: np.ndarray, room: float = _ROOM) -> np.ndarray:
    """Flags (n,) of the numbers at (n, 3) to show to an eye [m]: those that face it, in descending order, and
    do not overlap the ones before."""
    sight = eye - pos
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    facing = (sight * normal).sum(1)
    direction = sight.mean(0) / np.linalg.norm(sight.mean(0))
    across = pos - pos @ direction[:, None] * direction  # projection in the direction of sight
    visible = np.zeros(len(pos), bool)
    for i in np.argsort(-facing):
        distance = np.linalg.norm(across[visible] - across[i], axis=1)
        visible[i] = facing[i] > _FACING and (distance > room).all()
    return visible


class Numbers:
    """Labels at the electrodes of a page's fingers.

    Args:
      server: ViserServer. electrodes: {finger: (pos (19, 3) [m], normal (19, 3))} in its frame.

    Attributes:
      wanted: whether any are shown; `choose` acts on it.
    """

    def __init__(self, server: object, electrodes: dict):
        self.wanted = True
        self._server, self._electrodes, self._lock = server, electrodes, threading.Lock()
        self._labels, self._pose = {}, {name: (np.zeros(3), np.eye(3)) for name in electrodes}
        server.on_client_connect(self._add)
        server.on_client_disconnect(lambda client: self._labels.pop(client.client_id, None))

    def _add(self, client):
        look = dict(font_size_mode="scene", font_scene_height=_HEIGHT, anchor="center-center", visible=False)
        self._labels[client.client_id] = (
            client,
            [
                client.scene.add_label(f"/{name}/n{i}", str(i), position=p, **look)
                for name, (pos, normal) in self._electrodes.items()
                for i, p in enumerate(pos + _ABOVE * normal, 1)
            ],
        )
        client.camera.on_update(lambda _: self.choose())
        self.choose()

    def move(self, name: str, pos: np.ndarray, quat: np.ndarray) -> None:
        """Sets the pose of a finger in the world [m]; `choose` applies it."""
        self._pose[name] = np.asarray(pos), matrix(quat)

    def choose(self) -> None:
        """Chooses the numbers for each browser by its camera."""
        places = [
            (p + x @ R.T, n @ R.T) for (x, n), (p, R) in zip(self._electrodes.values(), self._pose.values())
        ]
        pos, normal = (np.concatenate(part) for part in zip(*places))
        with self._lock:
            for client, labels in list(self._labels.values()):
                visible = np.zeros(len(pos), bool)
                with contextlib.suppress(AssertionError):  # no camera is known yet
                    visible = legible(client.camera.position, pos, normal) & self.wanted
                for label, on in zip(labels, visible):
                    if label.visible != bool(on):
                        label.visible = bool(on)
