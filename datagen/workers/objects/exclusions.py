"""Objects of the YCB set that are left out because their data cannot be right, with the reasons.

Two rules work on any data: the density of the collision volume, and the by-name table below. Each
row of the table states the error; the figures were computed from the meshes (volume of the
convex parts) and the masses of the set's data sheet (B. Calli et al., "Benchmarking in
Manipulation Research", IEEE Robotics & Automation Magazine 22(3), 2015).
"""

from __future__ import annotations

from typing import NamedTuple

# Kitchen sponges weigh about 45 kg/m3 and hollow plastic ware, whose cavity the convex parts may
# fill, 60; below 20 there are only inflated objects in a household.
MIN_DENSITY_KG_M3 = 20.0
# Steel has 7850; convex parts of thin tools come out up to 15% too small in volume.
MAX_DENSITY_KG_M3 = 9000.0


class Exclusion(NamedTuple):
    """`mass_only`: the shape is right, so the object is usable with a mass from another source."""

    reason: str
    mass_only: bool


_AIRPLANE = "one mass, 0.114 kg, is given to five different parts of the toy (57 to 5350 kg/m3)"
_DUPLO = "one mass, 0.0372 kg, is given to six different bricks (460 to 1510 kg/m3; ABS has 1050)"

EXCLUDED: dict[str, Exclusion] = {
    "022_windex_bottle": Exclusion(
        "the scan lost the transparent neck: the trigger floats 16 mm above the bottle", False
    ),
    "028_skillet_lid": Exclusion(
        "the scan lost the glass: knob and rim are apart, and 0.652 kg would be 4170 kg/m3", False
    ),
    "059_chain": Exclusion("a chain of loose links, which one rigid body cannot stand for", False),
    "063-a_marbles": Exclusion("the mesh is a cluster of loose marbles", False),
    "063-b_marbles": Exclusion("0.001 kg for a 35 mm ball is 47 kg/m3, where glass has 2500", True),
    "070-a_colored_wood_blocks": Exclusion("the mesh is a stack of loose blocks, the mass is of one", False),
    "071_nine_hole_peg_test": Exclusion(
        "1.435 kg is 2080 kg/m3, twice the board's plastic; its nine pegs are loose", False
    ),
    **{f"072-{part}_toy_airplane": Exclusion(_AIRPLANE, True) for part in "abcde"},
    **{f"073-{part}_lego_duplo": Exclusion(_DUPLO, True) for part in "abcdef"},
    "073-g_lego_duplo": Exclusion("a toy car with a bell on a loose cord, which is no rigid body", False),
}


def reason_to_exclude(name: str, mass_kg: float, volume_m3: float, mass_is_measured: bool) -> str | None:
    """The reason why the object cannot be used, `cause: detail`, or None.

    `mass_is_measured` is False if the mass was derived from a density; rows about wrong published
    masses then do not apply.
    """
    row = EXCLUDED.get(name)
    if row is not None and (mass_is_measured or not row.mass_only):
        return f"{'wrong mass' if row.mass_only else 'wrong shape'}: {row.reason}"
    density = mass_kg / volume_m3
    if not MIN_DENSITY_KG_M3 <= density <= MAX_DENSITY_KG_M3:
        return (
            f"wrong density: {mass_kg:g} kg over {volume_m3 * 1e6:.3g} cm3 is {density:.3g} kg/m3, "
            f"outside {MIN_DENSITY_KG_M3:g} to {MAX_DENSITY_KG_M3:g}"
        )
    return None
