"""Videos as MP4 files, encoded frame by frame."""

from __future__ import annotations

import io
from fractions import Fraction

import av
from PIL.Image import Image

from datagen.schemas.errors import InputError

CODEC, PIXELS = "h264", "yuv420p"
# Few pictures between key frames, since readers draw frames at random; no pictures that need later ones.
# Without x264's macroblock tree, which reads memory that it never wrote: of 600 videos one had other bytes.
_OPTIONS = {"g": "10", "bf": "0", "crf": "25", "mbtree": "0"}


class Video:
    """A video of equally spaced pictures; equal ones give equal bytes. InputError without an encoder."""

    def __init__(self, size_px: tuple[int, int], fps: float) -> None:
        self._data = io.BytesIO()
        self._container = av.open(self._data, "w", format="mp4")
        try:
            self._stream = self._container.add_stream("libx264", Fraction(str(fps)), options=_OPTIONS)
        except ValueError as error:
            fix = "Install the extra export with PyAV's own wheel: pip install --force-reinstall av"
            raise InputError("av", "libx264", "is not an encoder of this build", fix) from error
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
