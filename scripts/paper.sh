#!/usr/bin/env bash
# The whole pipeline on real houses and objects: labels, a calibrated rule, two stages of training of this project's
# network and of the paper's, tables.
#
#   scripts/paper.sh small|full [FOLDER]        (make paper-small, make paper)
#
# Everything lies below FOLDER (build/paper-small, build/paper). Finished steps are skipped: the same command
# continues where it stopped. DATAGEN_ASSETS names the folder that has ycb/ and procthor/. Sizes can be set
# from outside (HEURISTIC=6000 scripts/paper.sh small FOLDER).
set -euo pipefail
ROOT=$(realpath "$(dirname "$0")/..")
. "$ROOT/scripts/campaign.sh"
SIZE=${1:-small}
OUT=$(realpath -m "${2:-$ROOT/build/paper$([ "$SIZE" = full ] || echo -small)}")

case $SIZE in
small)
    HEURISTIC=${HEURISTIC:-24000}       # labels of the rule, in training houses
    SIM_IN_RANGE=${SIM_IN_RANGE:-1500}  # trials at clear candidates within reach, in training houses
    SIM_CLEAR=${SIM_CLEAR:-1500}        # trials at clear candidates, in training houses
    VAL_IN_RANGE=${VAL_IN_RANGE:-900}   # the same in validation houses: for the rule, and to stop by
    VAL_CLEAR=${VAL_CLEAR:-600}
    TEST_IN_RANGE=${TEST_IN_RANGE:-1500}  # in test houses, with objects that nothing was trained on
    TEST_SCENES=${TEST_SCENES:-24}        # whole grids there
    EPOCHS_1=${EPOCHS_1:-6}             # at most, of stage 1 ...
    EPOCHS_2=${EPOCHS_2:-20}            # ... and of the trainings on trials
    ;;
full)
    HEURISTIC=${HEURISTIC:-180000}
    SIM_IN_RANGE=${SIM_IN_RANGE:-6000}
    SIM_CLEAR=${SIM_CLEAR:-6000}
    VAL_IN_RANGE=${VAL_IN_RANGE:-3000}
    VAL_CLEAR=${VAL_CLEAR:-3000}
    TEST_IN_RANGE=${TEST_IN_RANGE:-6000}
    TEST_SCENES=${TEST_SCENES:-100}
    EPOCHS_1=${EPOCHS_1:-8}
    EPOCHS_2=${EPOCHS_2:-20}
    ;;
*)
    echo "error: $SIZE: no such size. Say small or full" >&2
    exit 2
    ;;
esac
PER_SCENE=15  # trials in a scene, but for whole grids
CELLS=625     # a whole grid has so many
SEED=100      # each run has one of its own, counted from here
WORKERS=${WORKERS:-$(nproc)}  # processes that make labels; 0 for none but this one
FORM=any      # the distance that the calibrated rule may be a function of

need_assets_and_programs
mkdir -p "$OUT/runs" "$OUT/models"

# submit NAME LABELS SPLIT SEED OBJECTS, then the label source and its options: a run of that name.
submit() {
    local name=$1 n=$2 split=$3 seed=$4 objects=$5
    shift 5
    step "$name"
    datagen submit "$@" --n "$n" --split "$split" --seed $((SEED + seed)) --out "$OUT/runs/$name" \
        --houses "procthor:$ASSETS/procthor" --objects "ycb:$OUT/objects/$objects" --workers "$WORKERS"
}
# made_after FILE SOURCE...: whether the file is there and none of them is newer.
made_after() {
    local file=$1 source
    shift
    [ -s "$file" ] || return 1
    for source in "$@"; do ! [ "$source" -nt "$file" ] || return 1; done
}

# 1. Objects: four fifths to train on, and every fifth, which only the test runs have.
datagen assets split "$YCB" "$OUT/objects"

# 2. Labels: the paper's rule, which is cheap, and trials, which are not. No house is in two splits.
SOME=(--candidates-per-scene "$PER_SCENE" --config "$OUT/tops.toml") # the paper's scenes: open tops alone
printf '[scene]\nplaces = {}\n' > "$OUT/tops.toml"
submit heuristic "$HEURISTIC" train 0 train heuristic
submit train-in-range "$SIM_IN_RANGE" train 1 train sim --candidates in-range "${SOME[@]}"
submit train-clear "$SIM_CLEAR" train 2 train sim --candidates clear "${SOME[@]}"
submit val-in-range "$VAL_IN_RANGE" val 3 train sim --candidates in-range "${SOME[@]}"
submit val-clear "$VAL_CLEAR" val 4 train sim --candidates clear "${SOME[@]}"
submit test-in-range "$TEST_IN_RANGE" test 6 test sim --candidates in-range "${SOME[@]}"
submit test-grid $((TEST_SCENES * CELLS)) test 5 test sim --candidates grid

# 3. Parameters that the paper leaves open in its rule, fitted to trials in validation houses; labels by it.
if ! [ -f "$OUT/rule.toml" ]; then
    step "calibrate"
    datagen calibrate "$OUT/runs/val-in-range" "$OUT/runs/val-clear" --out "$OUT/rule.toml" \
        --candidates in-range --distance "$FORM"
fi
step "relabel"
datagen relabel "$OUT/runs/heuristic" --config "$OUT/rule.toml" --out "$OUT/runs/calibrated"

# 4. Three regimes: the rule's labels alone, trials alone, and trials after the rule's labels; the latter two
#    again with a quarter of the houses, since stage 1 should reduce the number of trials. The network is this
#    project's own, `shared`, not the paper's.
TRAIN_SIM=("$OUT/runs/train-in-range" "$OUT/runs/train-clear")
VAL_SIM=(--val "$OUT/runs/val-in-range" --val "$OUT/runs/val-clear")
step "our network: stage 1"
datagen train stage1 "$OUT/runs/calibrated" --out "$OUT/models/stage1.ckpt" --epochs "$EPOCHS_1"
# on_trials NAME SHARE: both trainings that learn from trials, from those in a share of the houses.
on_trials() {
    local sim=("${TRAIN_SIM[@]}" "${VAL_SIM[@]}" --house-share "$2" --epochs "$EPOCHS_2")
    step "our network: sim only$1"
    datagen train sim-only "${sim[@]}" --out "$OUT/models/sim-only$1.ckpt"
    step "our network: stage 2$1"
    datagen train stage2 "${sim[@]}" --out "$OUT/models/stage2$1.ckpt" --init "$OUT/models/stage1.ckpt"
}
on_trials "" 1
on_trials -quarter 0.25

# The paper's network, PointNet++ over cloud and candidate, in the same regimes. A training step of its full size
# takes 261 ms of a core for each sample, 240 times ours: here it has a quarter of the widths, half the points and
# a quarter of the centroids, 93,058 parameters of 1,462,786. PAPER_NETWORK names a file of other sizes.
if [ -z "${PAPER_NETWORK:-}" ]; then
    PAPER_NETWORK=$OUT/paper-network.toml
    cat > "$PAPER_NETWORK" << 'SIZES'
n_points = 1024
centroids = [128, 32]
neighbours = [16, 32]
widths = [[16, 16, 32], [32, 32, 64], [64, 128, 256]]
head = [128, 64]
SIZES
fi
PAPER=(--model paper --model-config "$PAPER_NETWORK")
WHOLE=("${TRAIN_SIM[@]}" "${VAL_SIM[@]}" --epochs "$EPOCHS_2")
step "the paper's network: stage 1"
datagen train stage1 "$OUT/runs/calibrated" --out "$OUT/models/paper-stage1.ckpt" --epochs "$EPOCHS_1" "${PAPER[@]}"
step "the paper's network: sim only"
datagen train sim-only "${WHOLE[@]}" --out "$OUT/models/paper-sim-only.ckpt" "${PAPER[@]}"
step "the paper's network: stage 2"
datagen train stage2 "${WHOLE[@]}" --out "$OUT/models/paper-stage2.ckpt" --init "$OUT/models/paper-stage1.ckpt"

# 5. Tables I to III, in houses and on objects that no model and no baseline has seen.
MODELS=("$OUT"/models/{stage1,sim-only,stage2,sim-only-quarter,stage2-quarter}.ckpt "$OUT"/models/paper-{stage1,sim-only,stage2}.ckpt)
FITTED=(--fit "$OUT/runs/val-in-range" --fit "$OUT/runs/val-clear" --heuristic "$OUT/rule.toml")
if ! made_after "$OUT/tables.json" "${MODELS[@]}" "$OUT/rule.toml"; then
    step "evaluate"
    datagen evaluate "${MODELS[@]}" "$OUT"/runs/test-{in-range,grid} "${FITTED[@]}" --full \
        --out "$OUT/tables.json" | tee "$OUT/tables.txt"
fi
step "done: tables.txt, tables.json and rule.toml in $OUT"
