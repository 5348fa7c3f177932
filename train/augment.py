"""Changes of a scene as it is read, so that no epoch shows a model the same cloud twice.

Labels and ids never change. Each effect is a frozen dataclass of numbers, off while it is None, and
draws from a generator of its own: switching one off changes nothing of the others.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Rotation:
    """The cloud turned about the target's vertical axis, and the candidates with it.

    The angle is uniform in [-largest_rad, largest_rad].
    """

    largest_rad: float = 3.141592653589793


@dataclass(frozen=True)
class SensorNoise:
    """Points moved along the camera's ray by a normal error of std_at_1m_m times depth squared (metres)."""

    std_at_1m_m: float = 0.0025


@dataclass(frozen=True)
class DepthHoles:
    """Round holes in the depth image, as a camera leaves them: points behind one vanish.

    Up to `most` holes of half-angles up to `largest_rad`, seen from the camera. A hole that would
    leave less than `target_kept` of the target's points is not made.
    """

    most: int = 4
    largest_rad: float = 0.05
    target_kept: float = 0.5


@dataclass(frozen=True)
class PointDropout:
    """A share of the points, uniform in [0, largest_share], vanishes; one of the target always stays."""

    largest_share: float = 0.3


@dataclass(frozen=True)
class ColourJitter:
    """Colours times one gain for all channels and one for each, uniform in 1 +- these shares."""

    brightness: float = 0.2
    channel: float = 0.1


@dataclass(frozen=True)
class Augmentation:
    """What is done to a scene, in this order; None leaves it out."""

    noise: SensorNoise | None = None
    holes: DepthHoles | None = None
    dropout: PointDropout | None = None
    colour: ColourJitter | None = None
    rotation: Rotation | None = None
