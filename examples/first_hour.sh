#!/bin/sh
# From raw files to a diagnosis, a model, a bundle, a broken sensor, maintenance and a report, with commands alone.
# A stopwatch shows how long each takes.
#
#   examples/first_hour.sh OUT [ARRAY...]     ARRAY: skin, lerobot (simulated), fabric, icub, insole, sdh; default: all
#
# The real arrays are read from DATA (default ../shared/data), and left out where it is absent. Each is first written as
# a user's own recordings lie there: one CSV file a recording, whose times are whole milliseconds, in a folder a class.
# "lerobot" is a LeRobot data set. EPOCHS (default 8) is the length of the training, SHAPE and GRASPS the size of what is
# simulated, PYTHON the interpreter that writes the LeRobot data set. Another exit code or cause than expected ends the
# script with exit code 1.
set -eu

out=${1:?give a folder for the results}
shift
data=${DATA:-../shared/data}
epochs=${EPOCHS:-8}
grasps=${GRASPS:-24}
adaptfault=${ADAPTFAULT:-adaptfault}
here=$(dirname "$0")

run() { # WANTED COMMAND...: run a command whose exit code has to be among those wanted, as "0 1"
    wanted=$1
    shift
    echo "\$ adaptfault $*"
    code=0
    began=$(date +%s)
    $adaptfault "$@" || code=$?
    echo "first_hour: $name: $(($(date +%s) - began)) s for $1, exit code $code"
    case " $wanted " in
    *" $code "*) ;;
    *)
        echo "first_hour: exit code $code where $wanted is expected: adaptfault $*" >&2
        exit 1
        ;;
    esac
}

as_csv() { # ARCHIVE OPTIONS...: its recordings as CSV files that state nothing but the times
    archive=$data/$1
    shift
    raw=$out/$name-csv
    if [ ! -e "$archive" ]; then
        raw=$archive
    elif [ ! -d "$raw" ]; then
        run 0 convert "$archive" --times --out "$raw" "$@"
        rm "$raw/layout.json"
    fi
}

first_hour() { # one array: $name $raw, the recordings kept back, the fault, the words of its cause, options
    echo "first_hour: $name"
    home=$out/$name
    mkdir -p "$home"
    # shellcheck disable=SC2086 # options are several words
    run 0 info "$raw" $scale --picture "$home/raw.png"
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
    run "$wanted_of_fault" diagnose "$home/broken.npz" --reference "$home/robot.bundle" --out "$home/diagnosis.json" \
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

[ $# -gt 0 ] || set -- skin lerobot fabric icub insole sdh
mkdir -p "$out"
for name in "$@"; do
    scale='' training="--epochs $epochs" later=::6 wanted_of_fault=2
    case $name in
    skin)
        # CSV files without times of one folder a class, and a layout.json.
        raw=$out/skin-csv fault=row:0:4=short cause="row 4 is short"
        [ -d "$raw" ] || run 0 simulate --shape "${SHAPE:-10x10}" --full-scale 3.3 --unit V --rate 20 \
            --grasps "$grasps" --frames 60 --classes nothing normal softer harder --out "$raw"
        ;;
    lerobot)
        raw=$out/lerobot-set fault=row:1:6=open cause="pad 1, row 6 is open"
        [ -d "$raw" ] || "${PYTHON:-python3}" "$here/lerobot_set.py" "$raw" --grasps "$grasps"
        ;;
    fabric)
        # A finger that slides over fabrics: 16 cells on one bus, which one file states. A single cell is no reason to
        # call somebody: exit code 1. SLIDES are the recordings that are taken.
        as_csv fabric4x4_slides7.npz --shape 4x4 --take "${SLIDES:-::3}"
        fault=cell:0:1:2=stuck:300 cause="pad 0, cell 6 is stuck" wanted_of_fault=1
        [ ! -d "$raw" ] || printf 'pads = 1\nrows = 4\ncols = 4\nwiring = "bus"\n' >"$raw/layout.toml"
        scale="--full-scale 4095 --unit count"
        ;;
    icub)
        # The shortest recordings, a class of their own, have 4 frames. They are few, so there are more epochs.
        as_csv icub5x1x12_grasps11.npz
        fault=row:1:0=short cause="pad 1, row 0 is short"
        scale="--shape 5x1x12 --full-scale 255 --unit count" training="--epochs $((4 * epochs)) --length 4"
        ;;
    insole)
        # Half of the positions hold no cell, which the files do not state: they always read 0.
        as_csv insole2x33x15.npz
        later=::8 fault=row:0:12=open cause="row 12 is open"
        scale="--shape 2x33x15 --full-scale 4095 --unit count"
        ;;
    sdh)
        as_csv sdh2x13x6_grasps36.npz
        fault=row:0:9=short cause="row 9 is short"
        scale="--shape 2x13x6 --full-scale 4095 --unit count"
        ;;
    *)
        echo "first_hour: no array $name: skin, lerobot, fabric, icub, insole, sdh" >&2
        exit 3
        ;;
    esac
    if [ -e "$raw" ]; then
        first_hour
    else
        echo "first_hour: $name: $raw is not there; left out"
    fi
done
