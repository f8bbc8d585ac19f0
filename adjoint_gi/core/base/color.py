"""Colour as numbers: the sRGB curve, and luminance. Everything else is scene-linear Rec.709."""

from __future__ import annotations

import numpy as np

LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec.709, as Cycles turns a colour into a number


def luminance(linear: np.ndarray) -> np.ndarray:
    """(...,) luminance of scene-linear colours (..., 3), in their type."""
    return linear @ np.array(LUMINANCE, linear.dtype)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB-encoded values (IEC 61966-2-1) of scene-linear ones, in their type; 0..1 is mapped to 0..1, nothing is clipped."""
    power = np.maximum(linear, 0.0) ** (1 / 2.4)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * power - 0.055).astype(linear.dtype)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """Scene-linear values of sRGB-encoded ones, in their type: the inverse of `encode_srgb`."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.0) + 0.055) / 1.055) ** 2.4).astype(encoded.dtype)
