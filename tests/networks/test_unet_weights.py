"""Weights are restored, and other files are refused."""

import pytest
import torch

from stream_dmr.errors import ModelError
from stream_dmr.networks.unet import load_weights, save_weights
from tests.support.random_unet import random_network


def test_weights_are_restored_but_for_rounding(tmp_path):
    network = random_network(3)
    save_weights(network, tmp_path / "unet.pt")
    again = load_weights(tmp_path / "unet.pt")
    for name, value in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=1e-3, atol=1e-3)


def test_files_that_are_no_weights_are_refused(tmp_path):
    (tmp_path / "text.pt").write_text("no weights")
    (tmp_path / "empty.pt").write_bytes(b"")
    torch.save({"format": "of another project"}, tmp_path / "other.pt")
    torch.save([1, 2, 3], tmp_path / "list.pt")
    save_weights(random_network(), tmp_path / "sound.pt")
    sound = torch.load(tmp_path / "sound.pt")
    spoilt = {name: value * float("nan") for name, value in sound["state"].items()}
    wider = {name: torch.zeros(9, *value.shape) for name, value in sound["state"].items()}
    fewer = dict(list(sound["state"].items())[1:])
    for name, state in (("nan", spoilt), ("wide", wider), ("few", fewer), ("number", 7)):
        torch.save({**sound, "state": state}, tmp_path / f"{name}.pt")
    torch.save({"format": sound["format"]}, tmp_path / "stateless.pt")
    for path in (*sorted(tmp_path.glob("[!s]*.pt")), tmp_path / "stateless.pt", tmp_path / "no.pt"):
        with pytest.raises(ModelError, match=path.name) as caught:
            load_weights(path)
        assert "\n" not in str(caught.value)
