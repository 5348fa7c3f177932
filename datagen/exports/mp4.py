"""Videos as MP4 files, encoded frame by frame."""

from __future__ import annotations

import io
from fractions import Fraction
from typing import TYPE_CHECKING

import av

if TYPE_CHECKING:
    from PIL.Image import Image

CODEC, PIXELS = "h264", "yuv420p"
# Few pictures between key frames, since readers draw frames at random; no pictures that need later ones.
_OPTIONS = {"g": "10", "bf": "0", "crf": "23"}


class Video:
    """A video of equally spaced pictures; equal pictures give equal bytes."""

    def __init__(self, size_px: tuple[int, int], fps: float) -> None:
        self._data = io.BytesIO()
        self._container = av.open(self._data, "w", format="mp4")
        self._stream = self._container.add_stream("libx264", Fraction(fps).limit_denominator(), _OPTIONS)
        self._stream.width, self._stream.height = size_px
        self._stream.pix_fmt = PIXELS
        self._stream.codec_context.thread_count = 1  # else bytes depend on the number of cores

    def add(self, picture: Image) -> None:
        """Append a picture of the video's size."""
        self._container.mux(self._stream.encode(av.VideoFrame.from_image(picture)))

    def finished(self) -> bytes:
        """The whole file; nothing can be added any more."""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        return self._data.getvalue()
