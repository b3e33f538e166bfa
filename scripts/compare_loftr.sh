#!/bin/sh
# Match a scene with LoFTR, with areas and on whole images, and print the main figures of both side by side.
#
#     scripts/compare_loftr.sh SCENE_IMAGES OUT [--device cuda ...]
#
# SCENE_IMAGES: a folder of photos. Results go to OUT/sgam and OUT/none; further options go to both runs. The weights
# are the file named by $SGAM_SFM_LOFTR_WEIGHTS, or what `--weights outdoor` finds.
set -eu

if [ $# -lt 2 ]; then
    echo "usage: $0 SCENE_IMAGES OUT [OPTIONS OF sgam-sfm match]" >&2
    exit 2
fi
images=$1
out=$2
shift 2

weights=$(python -c '
import os, sys
from pathlib import Path
from sgam_core.errors import WeightsError
from sgam_sfm.weights import LOFTR_OUTDOOR, find_weights

given = os.environ.get("SGAM_SFM_LOFTR_WEIGHTS")
try:
    print(find_weights(LOFTR_OUTDOOR, Path(given) if given else None))
except WeightsError as error:
    sys.exit(f"error: {error}; or set SGAM_SFM_LOFTR_WEIGHTS to it")
')

for areas in sgam none; do
    code=0
    sgam-sfm match --images "$images" --output "$out/$areas" --matcher loftr --weights "$weights" \
        --area-matcher "$areas" "$@" || code=$?
    case $code in
        0 | 3 | 4) ;; # done, some failed, no model: each has its summary
        *) exit "$code" ;;
    esac
done

python - "$out" <<'END'
import json
import sys
from pathlib import Path

runs = {name: json.loads(Path(sys.argv[1], name, "summary.json").read_text()) for name in ("sgam", "none")}
models = {name: run["models"][0] if run["models"] else {} for name, run in runs.items()}
figures = {
    "registered": {name: f"{models[name].get('registered', 0)}/{run['images']['used']}" for name, run in runs.items()},
    "points": {name: models[name].get("points", 0) for name in runs},
    "matches": {name: run["keypoints"]["matches"] for name, run in runs.items()},
    "inliers": {name: run["pairs"]["inliers"] for name, run in runs.items()},
    "seconds": {name: round(sum(run["seconds"].values())) for name, run in runs.items()},
}
print(f"{'loftr':12}" + "".join(f"{name:>12}" for name in runs))
for figure, values in figures.items():
    print(f"{figure:12}" + "".join(f"{values[name]:>12}" for name in runs))
END
