"""What runs networks: what the installed onnxruntime has, said where it is not the CPU alone."""

import sys

import numpy as np
import onnxruntime
import pytest

from stream_dmr.networks.onnx_session import (
    open_session,
    provider_notice,
    providers,
    providers_in_use,
)
from stream_dmr.segmentation.unet_segmenter import SHIPPED

CPU = "CPUExecutionProvider"


@pytest.mark.parametrize("preferred", ["CUDAExecutionProvider", "OpenVINOExecutionProvider"])
def test_what_is_installed_is_taken_but_nothing_remote(monkeypatch, preferred):
    installed = ["TensorrtExecutionProvider", preferred, "AzureExecutionProvider", CPU]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: installed)
    assert providers() == [preferred, CPU]


def test_nothing_is_said_of_the_cpu_or_before_a_network_is_opened(monkeypatch):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [CPU])
    assert provider_notice(SHIPPED) == ""
    monkeypatch.delitem(sys.modules, "onnxruntime")
    assert (providers_in_use(), provider_notice(SHIPPED)) == ("", "")


def test_how_far_another_provider_is_from_the_cpu_is_said(monkeypatch):
    """By one that is not here onnxruntime falls back to the CPU, so outputs are made to differ."""
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["XProvider", CPU])

    class Off:
        def __init__(self, session, factor):
            self._session, self._factor = session, factor
            self.get_inputs = session.get_inputs

        def run(self, names, feed):
            return [self._factor * np.asarray(one) for one in self._session.run(names, feed)]

    def opened(path, by=None):
        return Off(open_session(path, by=[CPU]), 1.0 if by == [CPU] else 1.02)

    monkeypatch.setattr("stream_dmr.networks.onnx_session.open_session", opened)
    assert "XProvider" in provider_notice(SHIPPED)
    assert "within 2.00% of the CPU" in provider_notice(SHIPPED)
