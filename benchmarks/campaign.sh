#!/usr/bin/env bash
# The campaign: samples, then training; both go on where they stopped. RECIPE=views (whole views) or windows (paper_small);
# RECIPE=autoencoder, then RECIPE=copies --from it, train what `windows --from` may begin with, on the windows; upon what
# they made, `encode` and then RECIPE=tokens --from it train the transformer alone. RECIPE=dstt makes clips of three
# views; dstt, fuseformer and e2fgvi learn from them, with --background white, --size-px, ... (docs/baselines.md).
#
#   RECIPE=views benchmarks/campaign.sh generate DIR PERFORMERS MOTIONS [COUNT]   one core: 2.4 views a second, 2 MB a
#                                            scene; or 1.3 windows a second, 1.4 MB each, with correspondences
#   benchmarks/campaign.sh encode DIR MODEL COUNT   windows of shards-windows by a model in DIR, in shards-tokens
#   RECIPE=views benchmarks/campaign.sh train DIR NAME MINUTES [options of viewmend train]
#
# One of eight characters and motions is put aside, and never drawn: a validation of one's own may have them.
set -euo pipefail
export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 MKL_NUM_THREADS=1
recipe=${RECIPE:-views} task=$1 folder=$2
shards=shards-$(sed 's/autoencoder\|copies/windows/; s/fuseformer\|e2fgvi/dstt/' <<<"$recipe") told=() clips=()
[ "$recipe" != windows ] || told=(--matches)
[ "$shards" != shards-dstt ] || clips=(--clip-length 3)
shift 2
mkdir -p "$folder"

put_apart() {  # SOURCE SUFFIX NAME REST: links to seven of eight files in NAME, to the others in NAME-val
    mkdir -p "$folder/$3" "$folder/$3-val"
    local number=0
    for file in "$1"/*"$2"; do
        number=$((number + 1))
        local where=$3
        [ $((number % 8)) != "$4" ] || where=$3-val
        ln -sfn "$(realpath "$file")" "$folder/$where/"
    done
}

case $task in
generate)
    put_apart "$1" .glb people 3
    put_apart "$2" .bvh motions 5
    cd "$folder"
    exec viewmend samples "$recipe" --out "$shards" --count "${3:-10400}" --performers people --motions motions "${told[@]}" "${clips[@]}"
    ;;
encode)
    cd "$folder"
    exec viewmend samples tokens --shards shards-windows --encoder "$1" --out shards-tokens --count "$2" --workers 0
    ;;
train)
    name=$1 minutes=$2
    shift 2
    cd "$folder"
    exec viewmend train "$recipe" --shards "$shards" --out "$name" --minutes "$minutes" --workers 0 \
        --validation-views 16 "${clips[@]}" "$@"
    ;;
*)
    echo "expected generate, encode or train, got $task; see the head of this file" >&2
    exit 2
    ;;
esac
