#!/bin/sh
# From raw files to a diagnosis, a model, a bundle, a broken sensor, maintenance and a report, with commands alone.
#
#   examples/first_hour.sh OUT [ARRAY...]        ARRAY: skin (simulated), icub, insole, sdh; default: all that are there
#
# The real arrays are read from DATA (default ../shared/data), and left out where it is absent. EPOCHS (default 8) is the
# length of the training, SHAPE and GRASPS the size of the simulated skin. Another exit code or cause than expected ends
# the script with exit code 1.
set -eu

out=${1:?give a folder for the results}
shift
data=${DATA:-../shared/data}
epochs=${EPOCHS:-8}
adaptfault=${ADAPTFAULT:-adaptfault}

run() { # WANTED COMMAND...: run a command whose exit code has to be among those wanted, as "0 1"
    wanted=$1
    shift
    echo "\$ adaptfault $*"
    code=0
    $adaptfault "$@" || code=$?
    case " $wanted " in
    *" $code "*) ;;
    *)
        echo "first_hour: exit code $code where $wanted is expected: adaptfault $*" >&2
        exit 1
        ;;
    esac
}

first_hour() { # one array: $name $raw, the recordings kept back, the fault, the words of its cause, options
    echo "first_hour: $name"
    home=$out/$name
    mkdir -p "$home"
    run 0 info "$raw" --picture "$home/raw.png"
    # The robot records these later: no model is trained on them.
    # shellcheck disable=SC2086 # options are several words
    run 0 convert "$raw" $scale --leave "$later" --out "$home/healthy.npz"
    run 0 convert "$raw" $scale --take "$later" --out "$home/later.npz"
    run "0 1" diagnose "$home/later.npz" --reference "$home/healthy.npz" --html "$home/later.html"
    # shellcheck disable=SC2086
    run 0 train "$home/healthy.npz" $training --out "$home/robot.bundle"
    run 0 evaluate "$home/robot.bundle" "$home/later.npz"
    # The sensor breaks.
    run 0 convert "$home/later.npz" --inject "$fault" --out "$home/broken.npz"
    run 2 diagnose "$home/broken.npz" --reference "$home/robot.bundle" --out "$home/diagnosis.json" \
        --picture "$home/diagnosis.png" --html "$home/diagnosis.html"
    grep -q "$cause" "$home/diagnosis.html" || {
        echo "first_hour: $name: no \"$cause\" in $home/diagnosis.html" >&2
        exit 1
    }
    run "1 2" maintain "$home/robot.bundle" "$home/broken.npz" --report "$home/maintenance.html"
    run 0 evaluate "$home/robot.bundle" "$home/broken.npz"
    run 0 report "$home/robot.bundle" --out "$home/report.html"
    echo "first_hour: $name: verdict right"
}

[ $# -gt 0 ] || set -- skin icub insole sdh
mkdir -p "$out"
for name in "$@"; do
    raw='' scale='' training="--epochs $epochs"
    case $name in
    skin)
        # CSV files of one folder a class and a layout.json, as a user's own recordings would lie there.
        raw=$out/skin-csv later=::6 fault=row:0:4=short cause="row 4 is short"
        [ -d "$raw" ] || run 0 simulate --shape "${SHAPE:-10x10}" --full-scale 3.3 --unit V --rate 20 \
            --grasps "${GRASPS:-24}" --frames 60 --classes nothing normal softer harder --out "$raw"
        ;;
    icub)
        # The shortest recordings, a class of their own, have 4 frames. They are few, so there are more epochs.
        raw=$data/icub5x1x12_grasps11.npz later=::6 fault=row:1:0=short cause="pad 1, row 0 is short"
        scale="--full-scale 255 --unit count" training="--epochs $((4 * epochs)) --length 4"
        ;;
    insole)
        raw=$data/insole2x33x15.npz later=::8 fault=row:0:12=open cause="row 12 is open"
        scale="--full-scale 4095 --unit count"
        ;;
    sdh)
        raw=$data/sdh2x13x6_grasps36.npz later=::6 fault=row:0:9=short cause="row 9 is short"
        scale="--full-scale 4095 --unit count"
        ;;
    *)
        echo "first_hour: no array $name: skin, icub, insole, sdh" >&2
        exit 3
        ;;
    esac
    if [ -e "$raw" ]; then
        first_hour
    else
        echo "first_hour: $name: $raw is not there; left out"
    fi
done
