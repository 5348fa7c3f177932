"""Layout of a film: eight moments on one sheet (.png), or an animation (.gif)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from datagen.drawing.film import OUTLINE_RGB, Film, pictures
from datagen.drawing.film_camera import Shot
from datagen.workers.geometry.mesh import U8

# Sizes of the far and the near view, (width, height), of a sheet and of an animation.
SHEET_WIDE_PX, SHEET_NEAR_PX = (460, 345), (460, 276)
MOTION_WIDE_PX, MOTION_NEAR_PX = (520, 400), (340, 400)

_COLUMNS, _SHARPNESS = 4, 2
_GAP_PX, _CAPTION_PX, _TITLE_PX, _LINE_PX = 10, 28, 44, 26
_FRAMES_PER_S, _MOST_FRAMES, _HOLD_MS = 10.0, 90, 1500
_PAPER, _INK, _PALE = (255, 255, 255), (20, 20, 20), (105, 105, 105)
_PHASE_RGB = {
    "reach": (120, 144, 190),
    "approach": (240, 170, 60),
    "close": (225, 95, 60),
    "lift": (60, 160, 95),
    "hold": (20, 105, 60),
}


@dataclass(frozen=True)
class Title:
    """The heading: a patch in the outcome's colour, the outcome, and lines of facts."""

    colour: str
    head: str
    lines: tuple[str, ...]


def write_sheet(film: Film, title: Title, out: Path) -> None:
    """Moments in rows of four: the far view, below it the near one."""
    told = film.told
    (w, h), (_, near_h) = _size(film.wide), _size(film.near)
    top = _TITLE_PX + _LINE_PX * len(title.lines) + _GAP_PX
    band = _CAPTION_PX + h + near_h + 2 * _GAP_PX
    columns = max(2, min(_COLUMNS, len(told)))  # the title needs two
    width = _GAP_PX + columns * (w + _GAP_PX)
    sheet = Image.new("RGB", (width, top + band * -(-len(told) // _COLUMNS)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    _write_title(draw, title, _GAP_PX)
    views = pictures(film, [moment for moment, _ in told], _SHARPNESS)
    for k, ((moment, words), (wide, near)) in enumerate(zip(told, views, strict=True)):
        x = _GAP_PX + (k % _COLUMNS) * (w + _GAP_PX)
        y = top + (k // _COLUMNS) * band
        draw.rectangle((x, y, x + w - 1, y + 5), fill=_PHASE_RGB.get(film.recording.phase[moment], _PALE))
        draw.text((x, y + 8), f"{k + 1}  {words}", _INK, _font(16, bold=True))
        draw.text((x + w, y + 10), _state(film, moment), _PALE, _font(13), anchor="ra")
        sheet.paste(Image.fromarray(wide), (x, y + _CAPTION_PX + 4))
        sheet.paste(Image.fromarray(near), (x, y + _CAPTION_PX + 7 + h))
    sheet.save(out)


def write_motion(film: Film, title: Title, out: Path) -> None:
    """The whole recording in real time at up to ten frames per second; the last one is shown longer."""
    recording = film.recording
    seconds = float(recording.time_s[-1] - recording.time_s[0])
    count = int(np.clip(round(seconds * _FRAMES_PER_S) + 1, 2, min(_MOST_FRAMES, len(recording.time_s))))
    moments = np.unique(np.linspace(0, len(recording.time_s) - 1, count).round().astype(int))
    frames = [
        _motion_frame(film, title, int(moment), wide, near)
        for moment, (wide, near) in zip(moments, pictures(film, list(moments), 1), strict=True)
    ]
    # One palette for all frames, so that static parts stay equal and compress well.
    sample = np.concatenate([np.asarray(frame) for frame in frames[:: max(1, len(frames) // 4)]])
    palette = Image.fromarray(np.concatenate([sample, _swatches(title, sample.shape[1])])).quantize(256)
    shown = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    step_ms = round(1000 * seconds / max(len(shown) - 1, 1))
    shown[0].save(
        out,
        save_all=True,
        append_images=shown[1:],
        duration=[step_ms] * (len(shown) - 1) + [_HOLD_MS],
        loop=0,
        optimize=False,
    )


def _swatches(title: Title, width: int) -> U8:
    """Areas of the colours with a meaning, large enough for a palette to keep them."""
    kept = [
        ImageColor.getrgb(title.colour),
        OUTLINE_RGB,
        *_PHASE_RGB.values(),
        *map(_paled, _PHASE_RGB.values()),
    ]
    return np.repeat(np.array(kept, np.uint8)[:, None, :], 60 * width, axis=1).reshape(-1, width, 3)


def _paled(rgb: tuple[int, int, int]) -> tuple[int, int, int]:
    r, g, b = ((c + 3 * 255) // 4 for c in rgb)
    return r, g, b


def _motion_frame(film: Film, title: Title, moment: int, wide: U8, near: U8) -> Image.Image:
    (w, h), (near_w, _) = _size(film.wide), _size(film.near)
    top = _TITLE_PX + _LINE_PX * len(title.lines) + _GAP_PX
    frame = Image.new("RGB", (w + near_w + 3 * _GAP_PX, top + h + _CAPTION_PX + 2 * _GAP_PX), _PAPER)
    draw = ImageDraw.Draw(frame)
    _write_title(draw, title, _GAP_PX)
    frame.paste(Image.fromarray(wide), (_GAP_PX, top))
    frame.paste(Image.fromarray(near), (w + 2 * _GAP_PX, top))
    y, full = top + h + _GAP_PX, w + near_w + _GAP_PX
    phases = film.recording.phase
    for k, phase in enumerate(phases):
        x0, x1 = (_GAP_PX + full * j / len(phases) for j in (k, k + 1))
        colour = _PHASE_RGB.get(phase, _PALE)
        draw.rectangle((x0, y, x1, y + 5), fill=colour if k <= moment else _paled(colour))
    draw.text((_GAP_PX, y + 9), film.words(moment), _INK, _font(16, bold=True))
    draw.text((_GAP_PX + full, y + 10), _state(film, moment), _PALE, _font(13), anchor="ra")
    return frame


def _write_title(draw: ImageDraw.ImageDraw, title: Title, x: int) -> None:
    draw.rectangle((x, 14, x + 22, 36), fill=title.colour)
    draw.text((x + 32, 11), title.head, _INK, _font(22, bold=True))
    for k, line in enumerate(title.lines):
        draw.text((x, _TITLE_PX + 4 + k * _LINE_PX), line, _PALE, _font(15))


def _size(shot: Shot) -> tuple[int, int]:
    return shot.camera.width_px, shot.camera.height_px


def _state(film: Film, moment: int) -> str:
    recording = film.recording
    if recording.time_s[-1] == recording.time_s[0]:  # poses, not a motion
        return ""
    rise_cm = round(100 * film.rise_m(moment), 1) + 0.0  # no -0.0
    return (
        f"{recording.time_s[moment] - recording.time_s[0]:.1f} s   "
        f"fingers {100 * recording.opening_m[moment]:.1f} cm   target {rise_cm:+.1f} cm"
    )


def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)
