# shellcheck shell=bash
# Sourced by scripts that run datagen's commands one after the other: paths of assets and programs, and steps.
# ROOT is the checkout. Sets ASSETS (DATAGEN_ASSETS, or ../shared/assets), YCB and BIN.
ASSETS=$(realpath -m "${DATAGEN_ASSETS:-$ROOT/../shared/assets}")
YCB=$ASSETS/ycb
[ -d "$YCB" ] || YCB=$ASSETS/mani_skill2_ycb  # as assets fetch has it
BIN=$(realpath -m "${BIN:-$ROOT/.venv/bin}")

# Ends the script where assets or programs are missing.
need_assets_and_programs() {
    if ! [ -d "$YCB" ] || ! [ -d "$ASSETS/procthor" ]; then
        echo "error: $ASSETS: no ycb/ and procthor/ there. Set DATAGEN_ASSETS to a folder that has both" >&2
        exit 2
    fi
    if ! [ -x "$BIN/datagen" ]; then
        echo "error: $BIN/datagen: no such program. Call \`make venv\`, or set BIN to an environment's bin/" >&2
        exit 2
    fi
}
step() { printf '\n== %s  (%d min %d s)\n' "$*" $((SECONDS / 60)) $((SECONDS % 60)); }
datagen() { "$BIN/datagen" "$@"; }
