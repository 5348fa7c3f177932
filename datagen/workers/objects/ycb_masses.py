"""Published masses of the YCB objects, kilograms, and objects that are left out, with the reasons.

Source: B. Calli, A. Walsman, A. Singh, S. Srinivasa, P. Abbeel, A. M. Dollar, "Benchmarking in
Manipulation Research: The YCB Object and Model Set and Benchmarking Protocols", IEEE Robotics &
Automation Magazine 22(3), 2015, tables of object data; bottles and cans are full.

Two rules work on any data: the density of the collision volume, and the by-name table `EXCLUDED`. Each row of
that table states the error; the figures were computed from the meshes (volume of the convex parts) and the
masses.
"""

from __future__ import annotations

from typing import NamedTuple

PUBLISHED_MASS_KG: dict[str, float] = {
    "001_chips_can": 0.205,
    "002_master_chef_can": 0.414,
    "003_cracker_box": 0.411,
    "004_sugar_box": 0.514,
    "005_tomato_soup_can": 0.349,
    "006_mustard_bottle": 0.603,
    "007_tuna_fish_can": 0.171,
    "008_pudding_box": 0.187,
    "009_gelatin_box": 0.097,
    "010_potted_meat_can": 0.370,
    "011_banana": 0.066,
    "012_strawberry": 0.018,
    "013_apple": 0.068,
    "014_lemon": 0.029,
    "015_peach": 0.033,
    "016_pear": 0.049,
    "017_orange": 0.047,
    "018_plum": 0.025,
    "019_pitcher_base": 0.178,
    "021_bleach_cleanser": 1.131,
    "022_windex_bottle": 1.022,
    "023_wine_glass": 0.133,
    "024_bowl": 0.147,
    "025_mug": 0.118,
    "026_sponge": 0.0062,
    "027_skillet": 0.950,
    "028_skillet_lid": 0.652,
    "029_plate": 0.279,
    "030_fork": 0.034,
    "031_spoon": 0.030,
    "032_knife": 0.031,
    "033_spatula": 0.0515,
    "035_power_drill": 0.895,
    "036_wood_block": 0.729,
    "037_scissors": 0.082,
    "038_padlock": 0.208,
    "040_large_marker": 0.0158,
    "042_adjustable_wrench": 0.252,
    "043_phillips_screwdriver": 0.097,
    "044_flat_screwdriver": 0.0984,
    "048_hammer": 0.665,
    "050_medium_clamp": 0.059,
    "051_large_clamp": 0.125,
    "052_extra_large_clamp": 0.202,
    "053_mini_soccer_ball": 0.123,
    "054_softball": 0.191,
    "055_baseball": 0.148,
    "056_tennis_ball": 0.058,
    "057_racquetball": 0.041,
    "058_golf_ball": 0.046,
    "061_foam_brick": 0.028,
    "062_dice": 0.0052,
    "065-a_cups": 0.013,
    "065-b_cups": 0.014,
    "065-c_cups": 0.017,
    "065-d_cups": 0.019,
    "065-e_cups": 0.021,
    "065-f_cups": 0.026,
    "065-g_cups": 0.028,
    "065-h_cups": 0.031,
    "065-i_cups": 0.035,
    "065-j_cups": 0.038,
    "070-b_colored_wood_blocks": 0.0108,
    "077_rubiks_cube": 0.094,
}


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
