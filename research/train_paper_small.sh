#!/bin/sh
# paper-small by the present recipe, which is not the one that made the shipped weights: from random weights, on one CPU core and a worker: samples, patch autoencoder, the paper's objective; then
# three shorter runs, and the mean of all weights.
#
#     research/train_paper_small.sh OUT PEOPLE MOTIONS
#
# PEOPLE and MOTIONS are folders of glTF characters and BVH motions. Repeat the command to resume. COUNT,
# PRETRAIN_MINUTES, MINUTES and LAST_MINUTES may be set; the weights are in OUT/mean.
set -eu
out=$1 people=$2 motions=$3

viewmend make-dataset paper-small --count "${COUNT:-6000}" --performers "$people" --motions "$motions" --out "$out/samples"
python "$(dirname "$0")/pretrain_paper.py" --shards "$out/samples" --minutes "${PRETRAIN_MINUTES:-20}" --out "$out/autoencoder"
viewmend train paper-small --from "$out/autoencoder" --shards "$out/samples" --minutes "${MINUTES:-240}" --out "$out/model"
for seed in 1 2 3; do
    viewmend train paper-small --from "$out/model" --shards "$out/samples" --minutes "${LAST_MINUTES:-60}" \
        --learning-rate 3e-4 --seed "$seed" --out "$out/run-$seed"
done
python "$(dirname "$0")/average_weights.py" "$out/model" "$out/run-1" "$out/run-2" "$out/run-3" --out "$out/mean"
