"""Maps of electrodes below a picture: tip on the left, E1..E6 below, in the colours of all pictures."""

import typing

import numpy as np

from ..geometry import load_skin
from ..press.report import unroll
from ..sensor.colors import FULL_CHANGE, electrode_colors

if typing.TYPE_CHECKING:
    from PIL.Image import Image

_SCALE = 6.0  # [pixel / mm]
_HEIGHT, _BAR = 180, 260  # height of the strip, largest width of the colour scale [pixel]


class Maps:
    """Draws maps of electrodes below pictures.

    Args:
      skin: name of the fingertips' skin.
    """

    def __init__(self, skin: str):
        from PIL import ImageFont

        around = unroll(load_skin(skin).electrode_pos) * [1, -1]  # a picture's rows go down
        self._place = _SCALE * (around - (around.min(0) + around.max(0)) / 2)
        self._font = ImageFont.load_default(size=14)

    def below(self, picture: np.ndarray, changes: dict[str, np.ndarray]) -> "Image":
        """A picture (height, width, 3) with a map for each fingertip and the scale below it.

        Args:
          changes: {title of a map: (nelectrode,) changes from the reference counts}.
        """
        from PIL import Image, ImageDraw

        height, width = picture.shape[:2]
        whole = Image.new("RGB", (width, height + _HEIGHT), "white")
        whole.paste(Image.fromarray(picture))
        draw = ImageDraw.Draw(whole)
        low, high = self._place.min(0), self._place.max(0)
        for i, (title, change) in enumerate(changes.items()):
            center = np.array([(i + 0.5) * width / len(changes), height + 24 + 0.5 * (_HEIGHT - 56)])
            draw.text((center[0], height + 4), title, "black", self._font, anchor="ma")
            tip = np.concatenate([center + low - 12, center + high + 12])
            draw.rounded_rectangle(tip.tolist(), radius=(tip[3] - tip[1]) / 2.5, fill="#cfe8da")
            for place, color in zip(self._place, electrode_colors(change)):
                box = np.concatenate([center + place - 6, center + place + 6])
                draw.ellipse(box.tolist(), tuple((255 * color[:3]).astype(int)), "#555")
        self._draw_scale(draw, width, height + _HEIGHT)
        return whole

    def _draw_scale(self, draw, width, bottom):
        less, more = f"-{FULL_CHANGE:.0f} counts, less liquid", f"+{FULL_CHANGE:.0f}, more"
        room = max(draw.textlength(text, self._font) for text in (less, more)) + 12
        bar = min(_BAR, int(width - 2 * room))
        left, half = (width - bar) / 2, bar / 2
        for x in range(bar):
            color = electrode_colors(np.array([(x / half - 1) * FULL_CHANGE]))[0, :3]
            draw.line([left + x, bottom - 20, left + x, bottom - 10], tuple((255 * color).astype(int)))
        for x, anchor, text in ((left - 6, "rm", less), (left + bar + 6, "lm", more)):
            draw.text((x, bottom - 15), text, "black", self._font, anchor=anchor)

    @staticmethod
    def quantize(pictures: "list[Image]", colors: int = 208) -> "list[Image]":
        """Pictures with one palette for a GIF: `colors` colours of the middle picture, and those of the
        electrodes, whose dots have few pixels."""
        from PIL import Image

        ramp = (255 * electrode_colors(np.linspace(-FULL_CHANGE, FULL_CHANGE, 48))[:, :3]).astype(np.uint8)
        middle = pictures[len(pictures) // 2].quantize(colors, method=Image.Quantize.MAXCOVERAGE)
        palette = Image.new("P", (1, 1))
        palette.putpalette(middle.getpalette()[: 3 * colors] + ramp.ravel().tolist())
        return [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
