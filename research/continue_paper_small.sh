#!/bin/sh
# The shipped paper-small, trained further, mostly on the paper's rigs: transformer and decoder first, then the encoder
# as well, and the mean of the weights before and after. The shipped weights are the second such mean.
#
#     research/continue_paper_small.sh OUT PEOPLE MOTIONS
#
# PEOPLE and MOTIONS are folders of glTF characters and BVH motions. Repeat the command to resume. MINUTES and
# ALL_MINUTES may be set.
set -eu
out=$1 people=$2 motions=$3

viewmend train paper-small --from paper-small --no-train-encoder --performers "$people" --motions "$motions" \
    --batch 4 --learning-rate 3e-4 --minutes "${MINUTES:-240}" --out "$out/transformer"
viewmend train paper-small --from "$out/transformer" --performers "$people" --motions "$motions" \
    --batch 4 --learning-rate 2e-4 --minutes "${ALL_MINUTES:-480}" --out "$out/all"
python "$(dirname "$0")/average_weights.py" paper-small "$out/all" --out "$out/mean"
