"""Layout of a film: eight moments on one sheet (.png), or an animation (.gif)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from datagen.display.styles import PHASE_COLOURS
from datagen.drawing.film import OUTLINE_RGB, Film, pictures
from datagen.workers.geometry.mesh import U8

# Sizes of the far and the near view, (width, height), of a sheet and of an animation.
SHEET_WIDE_PX, SHEET_NEAR_PX = (460, 345), (460, 276)
MOTION_WIDE_PX, MOTION_NEAR_PX = (520, 400), (340, 400)

_COLUMNS, _SHARPNESS = 4, 2
_GAP_PX = 10
_FRAMES_PER_S, _MOST_FRAMES, _HOLD_MS = 10.0, 90, 1500
_PAPER, _INK, _PALE = "#ffffff", "#141414", "#555555"
# Heights of letters, in pixels. Pages show a sheet at less than half its width.
_SHEET_TEXT_PX, _MOTION_TEXT_PX = 27, 15


@dataclass(frozen=True)
class Title:
    """The heading: a patch in the outcome's colour, the outcome, and lines of facts."""

    colour: str
    head: str
    lines: tuple[str, ...]


def write_sheet(film: Film, title: Title, out: Path) -> None:
    """Write the moments in rows of four: the far view, below it the near one."""
    moments, text_px = film.moments, _SHEET_TEXT_PX
    (w, h), (_, near_h) = film.wide_px, film.near_px
    top, caption_px = _title_px(title, text_px), 2 * round(1.3 * text_px) + _GAP_PX
    band = caption_px + h + near_h + 2 * _GAP_PX
    columns = max(2, min(_COLUMNS, len(moments)))  # two have room for the title
    width = _GAP_PX + columns * (w + _GAP_PX)
    sheet = Image.new("RGB", (width, top + band * -(-len(moments) // _COLUMNS)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    _write_title(draw, title, text_px)
    views = pictures(film, [moment for moment, _ in moments], _SHARPNESS)
    for k, ((moment, words), (wide, near)) in enumerate(zip(moments, views, strict=True)):
        x = _GAP_PX + (k % _COLUMNS) * (w + _GAP_PX)
        y = top + (k // _COLUMNS) * band
        draw.rectangle((x, y, x + w - 1, y + 7), fill=_phase_colour(film, moment))
        draw.text((x, y + 9), f"{k + 1}  {words}", _INK, _font(text_px, bold=True))
        time, state = _state(film, moment)
        draw.text((x + w, y + 9), time, _PALE, _font(text_px - 2), anchor="ra")
        draw.text((x, y + 9 + round(1.25 * text_px)), state, _PALE, _font(text_px - 2))
        sheet.paste(Image.fromarray(wide), (x, y + caption_px))
        sheet.paste(Image.fromarray(near), (x, y + caption_px + 3 + h))
    sheet.save(out, optimize=True)


def write_motion(film: Film, title: Title, out: Path) -> None:
    """Write the whole recording in real time, at up to ten frames per second; the last frame stays longer."""
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
    colours = [ImageColor.getrgb(colour)[:3] for colour in (title.colour, *PHASE_COLOURS.values())]
    kept = [*colours, OUTLINE_RGB, *map(_pale, PHASE_COLOURS.values())]
    return np.repeat(np.array(kept, np.uint8)[:, None, :], 60 * width, axis=1).reshape(-1, width, 3)


def _pale(colour: str) -> tuple[int, int, int]:
    r, g, b = ((c + 3 * 255) // 4 for c in ImageColor.getrgb(colour)[:3])
    return r, g, b


def _motion_frame(film: Film, title: Title, moment: int, wide: U8, near: U8) -> Image.Image:
    (w, h), (near_w, _) = film.wide_px, film.near_px
    text_px = _MOTION_TEXT_PX
    top, full = _title_px(title, text_px), w + near_w + _GAP_PX
    frame = Image.new("RGB", (full + 2 * _GAP_PX, top + h + 2 * text_px + 2 * _GAP_PX), _PAPER)
    draw = ImageDraw.Draw(frame)
    _write_title(draw, title, text_px)
    frame.paste(Image.fromarray(wide), (_GAP_PX, top))
    frame.paste(Image.fromarray(near), (w + 2 * _GAP_PX, top))
    y, phases = top + h + _GAP_PX, film.recording.phase
    for k in range(len(phases)):
        x0, x1 = (_GAP_PX + full * j / len(phases) for j in (k, k + 1))
        colour = _phase_colour(film, k)
        draw.rectangle((x0, y, x1, y + 5), fill=colour if k <= moment else _pale(colour))
    draw.text((_GAP_PX, y + 9), film.words(moment), _INK, _font(text_px, bold=True))
    state = "   ".join(_state(film, moment))
    draw.text((_GAP_PX + full, y + 9), state, _PALE, _font(text_px - 2), anchor="ra")
    return frame


def _phase_colour(film: Film, moment: int) -> str:
    return PHASE_COLOURS.get(film.recording.phase[moment], _PALE)


def _title_px(title: Title, text_px: int) -> int:
    return round((1.9 + 1.4 * len(title.lines)) * text_px) + 2 * _GAP_PX


def _write_title(draw: ImageDraw.ImageDraw, title: Title, text_px: int) -> None:
    chip_px = round(1.3 * text_px)
    draw.rectangle((_GAP_PX, 14, _GAP_PX + chip_px, 14 + chip_px), fill=title.colour)
    draw.text((2 * _GAP_PX + chip_px, 11), title.head, _INK, _font(round(1.3 * text_px), bold=True))
    for k, line in enumerate(title.lines):
        draw.text((_GAP_PX, (1.9 + 1.4 * k) * text_px + _GAP_PX), line, _PALE, _font(text_px))


def _state(film: Film, moment: int) -> tuple[str, str]:
    """Time, and what hand and target do; empty for poses without motion."""
    recording = film.recording
    if recording.time_s[-1] == recording.time_s[0]:
        return "", ""
    rise_cm = round(100 * film.rise_m(moment), 1) + 0.0  # no -0.0
    seconds = recording.time_s[moment] - recording.time_s[0]
    return f"{seconds:.1f} s", f"opening {100 * recording.opening_m[moment]:.1f} cm   lift {rise_cm:.1f} cm"


def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)
