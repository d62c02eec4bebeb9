"""Pictures side by side, and how far two of them are apart."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

#: The part that is shown larger: from and to, as shares of the width and the height.
ZOOM = ((0.38, 0.63), (0.36, 0.56))


def srgb(picture: np.ndarray) -> np.ndarray:
    """A linear picture as sRGB, 0 to 1."""
    v = np.clip(picture, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055).astype(np.float32)


def zoom(picture: np.ndarray) -> np.ndarray:
    """The part ``ZOOM`` at the picture's own width, pixels repeated."""
    height, width, _ = picture.shape
    (left, right), (top, bottom) = ([int(share * side) for share in shares] for shares, side in zip(ZOOM, (width, height)))
    times = -(-width // (right - left))
    return picture[top:bottom, left:right].repeat(times, 0).repeat(times, 1)[:, :width]


def error_times_five(picture: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The absolute difference of two linear pictures, mean over the channels, × 5, from black over red and yellow to white at 1."""
    t = 5 * np.abs(picture - reference).mean(-1)
    return np.clip(np.stack([3 * t, 3 * t - 1, 3 * t - 2], -1), 0, 1).astype(np.float32)


def psnr_db(picture: np.ndarray, reference: np.ndarray) -> float:
    """Of linear pictures clipped to 0…1, peak 1."""
    error = np.mean((np.clip(picture, 0, 1) - np.clip(reference, 0, 1)) ** 2)
    return float(-10 * np.log10(max(error, 1e-12)))


def flip(picture: np.ndarray, reference: np.ndarray) -> float:
    """Mean FLIP of the sRGB pictures at 67 pixels a degree."""
    import flip_evaluator

    return float(flip_evaluator.evaluate(srgb(reference), srgb(picture), "LDR")[1])


def flip_if_there(picture: np.ndarray, reference: np.ndarray) -> float | None:
    """:func:`flip`, or ``None`` where ``flip-evaluator`` is not installed: it has no wheel for every system."""
    try:
        return flip(picture, reference)
    except ModuleNotFoundError:
        return None


def labelled(picture: np.ndarray, text: str) -> np.ndarray:
    """With a text at its top."""
    image = _image(picture)
    ImageDraw.Draw(image).text((6, 4), text, fill=(255, 255, 255))
    return np.asarray(image, np.float32) / 255


def column(pictures: list[np.ndarray]) -> np.ndarray:
    """One below the other."""
    return np.concatenate(pictures)


def row(pictures: list[np.ndarray]) -> Image.Image:
    """Side by side, filled with black below."""
    height = max(len(p) for p in pictures)
    return _image(np.concatenate([np.pad(p, ((0, height - len(p)), (0, 0), (0, 0))) for p in pictures], 1))


def _image(picture: np.ndarray) -> Image.Image:
    return Image.fromarray((np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8))
