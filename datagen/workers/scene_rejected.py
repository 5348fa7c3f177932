"""The exception for a rejected scene."""

from __future__ import annotations

from datagen.schemas.outcomes import REDRAW_CAUSES


class SceneRejected(Exception):
    """The scene is rejected and resampled; `cause` is one of REDRAW_CAUSES, `detail` optional text."""

    def __init__(self, cause: str, detail: str = "") -> None:
        if cause not in REDRAW_CAUSES:
            raise KeyError(f"unknown redraw cause {cause!r}; causes are {', '.join(REDRAW_CAUSES)}")
        super().__init__(cause)
        self.cause = cause
        self.detail = detail
