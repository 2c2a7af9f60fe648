"""Geometry for a renderer: the deformed outer surface as a MuJoCo skin, the electrodes coloured by their
change from rest."""

import numpy as np

from ..sensor.colors import electrode_colors

# what all pictures show: as in mjcf/biotac.xml, and of what touches the skin
SKIN, CORE, OBJECT = np.array([0.25, 0.6, 0.4]), np.array([0.25, 0.25, 0.28]), np.array([0.85, 0.45, 0.15])
# turns the pad, -y of the BioTac, to +z of the world
PAD_UP = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0])


class Shown:
    """The visible parts of one `Instance`."""

    def __init__(self, instance: object):
        self.instance = instance
        setup, model = instance.setup, instance.model
        self.node = np.unique(setup.skin.geometry.outer_face)
        skins, sites = setup.named("skin"), setup.named("site")
        self.vert = None
        if "skin" in skins and model.skin_vertnum[skins["skin"]] == len(self.node):
            start = int(model.skin_vertadr[skins["skin"]])
            self.vert = slice(start, start + len(self.node))
        self.site = np.array(
            [sites[name] for name in setup.skin.geometry.design.electrodes if name in sites], dtype=np.int64
        )
        self.rest = setup.skin.readings.rest.get("electrodes")

    def update(self) -> None:
        instance = self.instance
        skin, state = instance.setup.skin, instance.setup.parts(instance.state)[2]
        if self.vert is not None:
            with skin.lock:
                instance.model.skin_vert[self.vert] = skin.stepper.vert_xpos(state)[self.node]
        if self.rest is not None and len(self.site) and "electrodes" in instance.sensor:
            counts = instance.data.sensordata[instance.sensor["electrodes"]]
            instance.model.site_rgba[self.site] = electrode_colors(
                counts - self.rest if counts.any() else np.zeros(len(counts))
            )
