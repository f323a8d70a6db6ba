"""What a command cannot do is one line that says what was expected; nothing is left behind."""

import pytest

from viewmend.cli import main

BRIEF = "--steps 2 --batch 2 --workers 0 --validate-every 0"
HELD = "mend {ball} --out out --model telea --leave-out held"
MISTAKES = {
    "check": {
        "nothing": "expected a capture folder with nothing/cameras.json, but there is no such folder; check the"
    },
    "check {ball}": {"--out check.txt": "the file name of an image"},
    "demo --out out": {"--frames 0": "--frames of at least 1, got 0"},
    "studio out": {
        "--frames 0": "--frames of at least 1, got 0",
        "--cameras 3": "--cameras of at least 4, got 3",
        "--seed -1": "--seed of at least 0, got -1",
        "--performers nowhere --motions nowhere": "nowhere",
        "--performers nowhere": "no motions",
    },
    "evaluate --out out": {
        "P --scenes 0": "--scenes of at least 1, got 0",
        "P --every 0": "--every of at least 1, got 0",
        "P --num-source-views 0": "expected --num-source-views of at least 1, got 0",
        "": "got no set",
        "Q": "expected --performers DIR",
        "P --methods magic": "got 'magic'",
        "P --device tpu": "expected an available device",
        "P --weights nowhere": "expected a folder of weights",
        "P P-turn --background stage": "expected sets that --background can change, got P, P-turn",
        "Q --performers people --background stage": "--background",
        "P --inputs 4": "expected sets that --inputs can change, got P; leave it out",
        "R48 --no-match-colours": "expected sets that --no-match-colours can change",
        "P-turn --performers people": "expected sets that --performers can change",
        "no-such-capture --size 320": "expected sets that --size can change",
        "P no-such-capture --size 320 --inputs 4": "no such folder",
        "no-such-capture": "no-such-capture",
        "no-such-capture --inputs ,": "expected --inputs all or a number",
    },
    "evaluate paper-table": {
        "2 --out out": "expected captures",
        "3 --out out": "expected --models DIR",
        "3 --models x --out out": "x:",
    },
    HELD: {
        "--cameras c0 absent": "absent",
        "--cameras c0": "at least 2 input cameras, got 1",
        "--path orbit": "either --leave-out CAMERA or --path",
        "--frames 5:9": "--frames FIRST:END within 0:2",
        "--frames x": "--frames FIRST:END within 0:2",
        "--num-source-views 0": "--num-source-views of at least 1",
        "--device abacus": "expected an available device",
        "--error-rule some": "expected an error rule among",
    },
    "mend {ball} --out out": {
        "": "either --leave-out CAMERA or --path",
        "--leave-out absent": "expected --leave-out among",
        "--leave-out held --model nothing": "nothing",
        "--path missing.json": "missing.json",
        "--path orbit --protocol target-mask": "expected --leave-out with --protocol target-mask",
    },
    "serve": {
        "nowhere": "nowhere",
        "--host 0.0.0.0": "expected --token with --host 0.0.0.0",
        "--port -1": "--port",
        "--budget-ms nan": "--budget-ms",
        "--fps 0": "--fps",
        "--model nothing": "nothing",
        "--device tpu": "tpu",
        "--broadcast 1280": "expected --broadcast WIDTHxHEIGHT",
        "--broadcast 1280x719": "even",
        "--broadcast 1280x14": "from 16",
        "--broadcast 4096x4096": "2048",
        "--broadcast 1280x720 --ray local": "--broadcast or --ray",
        "live --max-image-size 512": "expected neither --max-image-size nor",
        "live --no-align": "whose frames are used as they are pushed",
    },
    "train": {
        "smal": "expected a recipe among",
        "finetune": "expected viewmend train finetune CAPTURE",
        "finetune --captures here --from=nothing": "one of the shipped models",
        "views --performers people": "both --performers and --motions",
        f"views --shards nowhere {BRIEF}": "expected tar files, found none",
        "views --from nothing": "one of the shipped models",
        f"views --train-params errors {BRIEF}": "give --from MODEL",
        f"paper --from views {BRIEF}": "expected a PatchTransformer of the recipe's sizes",
        "views --steps 0": "steps of 0",
        "views --checkpoint-minutes -1": "checkpoint_minutes of -1",
        "views --minutes nan": "minutes of nan",
        "views --batch 0": "batch of 0",
        "views --cameras 3 80": "--cameras MIN MAX of 4 to 60",
        "views --performers nowhere --motions nowhere": "nowhere: expected",
        "dstt --from absent.pth": "absent.pth: expected a file of weights, found none",
        "fuseformer --size-px 64 108": "frames of 432x240",
        f"e2fgvi --clip-length 6 {BRIEF}": "expected --clip-length of 1 to 5",
    },
    "make-dataset": {"--count 0": "--count of at least 1", "tokens": "a recipe among"},
    "export-scene {ball} out": {
        "--views 0": "expected --views",
        "--min-confidence 2": "expected --min-confidence",
        "--frames 5:": "expected --frames",
    },
    "export": {
        "paper-small --format onnx --out m.onnx": "train views, got 'paper-small', a PatchTransformer; other models",
        "telea --format onnx --out m.onnx": "got 'telea', which is neither a shipped model nor a folder; other models",
        "views --format pt2 --out m.onnx": "expected --out to end in .pt2, got",
        "views --format onnx --out none/m.onnx": "expected a folder to write to, found none",
        "no-such-model --format onnx --out m.onnx": "expected 'views', or the folder",
    },
}


CASES = [
    (f"{command} {options}", said) for command, wrong in MISTAKES.items() for options, said in wrong.items()
]


@pytest.mark.parametrize(("command", "message"), CASES)
def test_a_mistake_is_one_line_and_leaves_nothing(command, message, folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(command.format(ball=folder).split()) == 2
    out, error = capsys.readouterr()
    assert message in error and error.count("\n") == 1 and out == ""
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
