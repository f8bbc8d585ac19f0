"""The sRGB curve and luminance."""

import numpy as np
import pytest
from adjgi.adjoint_gi.core.base.color import decode_srgb, encode_srgb, luminance


@pytest.mark.parametrize(("linear", "coded"), [(0.0, 0.0), (0.002, 0.02584), (0.2158605, 128 / 255), (1.0, 1.0)])
def test_srgb_has_the_values_of_the_standard(linear, coded):
    assert encode_srgb(np.array([linear]))[0] == pytest.approx(coded, abs=1e-6)
    assert decode_srgb(np.array([coded]))[0] == pytest.approx(linear, abs=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_decoding_undoes_encoding_in_the_same_type(dtype):
    x = np.linspace(0, 4, 1001).astype(dtype)
    back = decode_srgb(encode_srgb(x))
    assert back.dtype == encode_srgb(x).dtype == luminance(np.zeros((2, 3), dtype)).dtype == dtype
    assert np.allclose(back, x, rtol=4e-6, atol=1e-6)


def test_white_has_luminance_one():
    assert luminance(np.ones((2, 3)))[1] == pytest.approx(1.0)
    assert luminance(np.eye(3)).argmax() == 1
