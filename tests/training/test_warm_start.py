"""A net that begins with the weights of an exported model answers as that model does."""

from __future__ import annotations

import numpy as np
import pytest

from swarmtrack.agents.main import main
from swarmtrack.detection.detector import Detector
from swarmtrack.errors import ModelError

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")
adopt = pytest.importorskip("swarmtrack.training.warm_start").adopt
create_network = pytest.importorskip("swarmtrack.training.network").create_network
export = pytest.importorskip("swarmtrack.training.export").export


def pictures(seed=0):
    return torch.from_numpy(np.random.default_rng(seed).random((8, 3, 64, 64), np.float32))


def exported(path, name="nano"):
    torch.manual_seed(3)
    network = create_network(name).train()
    for seed in range(3):
        network(3.0 * pictures(seed) - 0.5)  # normalisations measure something else than what they start with
    export(network, path, {})
    return network.eval()


def test_in_training_and_in_flight_it_begins_with_the_answers_of_the_file(tmp_path):
    before = exported(tmp_path / "a.onnx")
    network = create_network("nano")
    adopt(network, tmp_path / "a.onnx", pictures(9))
    with torch.no_grad():
        wanted, flown = before(pictures(9)), network.eval()(pictures(9))
        trained = network.train()(pictures(9))
    for a, b, c in zip(wanted, flown, trained, strict=True):
        assert torch.allclose(a, b, atol=1e-4)
        assert torch.allclose(a, c, atol=2e-2)


@pytest.mark.parametrize("name", ["plain", "resnet34"])
def test_another_network_is_refused(tmp_path, name):
    exported(tmp_path / "a.onnx")
    with pytest.raises(ModelError, match="another network"):
        adopt(create_network(name), tmp_path / "a.onnx", pictures())


def test_a_training_starts_with_a_model_and_says_with_which(tmp_path):
    exported(tmp_path / "a.onnx")
    few = ["--batch", "2", "--network", "nano", "--crop", "64", "--iterations", "1"]
    out = tmp_path / "b.onnx"
    assert main(["train", *few, "--start", str(tmp_path / "a.onnx"), "--out", str(out)]) == 0
    entries = Detector(out).description.entries
    assert entries["warm_start"] == "a.onnx"
    assert len(entries["warm_start_sha256"]) == 64


def test_a_file_that_is_no_model_is_named(tmp_path, capsys):
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    code = main(
        [
            "train",
            "--out",
            str(tmp_path / "m.onnx"),
            "--iterations",
            "1",
            "--start",
            str(tmp_path / "junk.onnx"),
        ]
    )
    assert code == 2
    assert "junk.onnx: not an ONNX file" in capsys.readouterr().err
