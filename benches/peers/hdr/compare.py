"""Merges of the same stacks by several programs, against the truth and the Cramér–Rao bound.

python compare.py STACK, where STACK is what `ACQUIRE_STACK=STACK cargo bench --bench merge` wrote.
Peers that do not keep an absolute scale are given the best one: the median ratio to the truth over all levels.
"""

import contextlib
import io
import json
import logging
import os
import sys
import tempfile
import warnings

import cv2
import numpy as np

warnings.filterwarnings("ignore")
logging.disable(logging.WARNING)
stack = sys.argv[1]
about = json.load(open(os.path.join(stack, "stack.json")))
times = np.array(about["exposure_secs"])
gain, black, full = about["gain_dn_per_electron"], about["black_dn"], about["max_dn"]
saturation = about["saturation_dn"]
codes = [cv2.imread(os.path.join(stack, f"exposure-{k}.png"), cv2.IMREAD_UNCHANGED) for k in range(len(times))]
truth = np.array(about["electrons_per_sec"]) * gain
bound = np.array(about["bound_variance"], float) * gain**2  # NaN where no code says anything
levels, width = len(truth), about["width"]
rows = about["rows"]


def ours():
    def read(name, kind):
        return np.fromfile(os.path.join(stack, name), kind).reshape(codes[0].shape)

    value = read("value.f32", np.float32).astype(float)
    value[read("used.u8", np.uint8) == 0] = np.nan  # masked
    return value, read("variance.f32", np.float32)


def linear():
    return [c.astype(float) - black for c in codes], [c >= saturation for c in codes]


def hat():
    """Triangle weights over the range of code values, y/t averaged."""
    top = bottom = 0.0
    for (y, _), t in zip(zip(*linear()), times):
        share = (y + black) / full
        w = np.clip(np.minimum(share, 1 - share), 0, None)
        top, bottom = top + w * y / t, bottom + w
    return top / bottom


def plain():
    """Mean of y/t over exposures between 5 and 95 % of the range."""
    top = bottom = 0.0
    for (y, _), t in zip(zip(*linear()), times):
        w = ((y > 0.05 * (full - black)) & (y < 0.95 * (full - black))).astype(float)
        top, bottom = top + w * y / t, bottom + w
    return top / bottom


def longest():
    """The longest exposure that is not saturated."""
    value = np.full(codes[0].shape, np.nan)
    for (y, high), t in zip(zip(*linear()), times):
        value = np.where(high, value, y / t)
    return value


def photons():
    """Sum of y over sum of t, unsaturated exposures."""
    top = bottom = 0.0
    for (y, high), t in zip(zip(*linear()), times):
        top, bottom = top + np.where(high, 0, y), bottom + np.where(high, 0, t)
    return top / bottom


def encode(share):
    return np.where(share <= 0.0031308, 12.92 * share, 1.055 * np.power(np.maximum(share, 1e-9), 1 / 2.4) - 0.055)


def decode(value):
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def eight_bits(curved):
    """OpenCV takes 8 bits only: black subtracted, scaled to 255, linear or with the sRGB curve, as a camera's JPEG."""
    pictures = []
    for c in codes:
        share = np.clip((c.astype(float) - black) / (full - black), 0, 1)
        pictures.append(np.repeat(np.round(255 * (encode(share) if curved else share)).astype(np.uint8)[..., None], 3, 2))
    return pictures


def response(curved):
    v = np.arange(256) / 255
    table = np.maximum(decode(v) if curved else v, 1e-6 / 255)
    return np.repeat(table.astype(np.float32)[:, None, None], 3, 2)


def opencv(create, curved):
    # The true response is handed over, so that only merging is compared.
    return create().process(eight_bits(curved), times.astype(np.float32), response(curved))[..., 1].astype(float)


def hdrutils():
    """Without raw files it takes a Bayer mosaic; each place keeps the value of its own colour.

    Version 1.2 reads no TIFF (its reader forgets to) and PNG by a plugin that is downloaded: PGM goes through.
    """
    import HDRutils

    with contextlib.redirect_stderr(io.StringIO()), tempfile.TemporaryDirectory() as folder:
        files = []
        for k, c in enumerate(codes):
            files.append(os.path.join(folder, f"{k}.pgm"))
            cv2.imwrite(files[-1], np.pad(c, 2, mode="symmetric"))  # its demosaicing errs at the rim
        value, _ = HDRutils.merge(files, demosaic_first=False, color_space="raw", exp=list(times), gain=[1] * len(times),
                                  aperture=[1] * len(times), black_level=black, bits=14, demosaic="bilinear")
    value = value[2:-2, 2:-2]
    own = np.empty(codes[0].shape)
    own[0::2, 0::2], own[1::2, 1::2] = value[0::2, 0::2, 0], value[1::2, 1::2, 2]
    own[0::2, 1::2], own[1::2, 0::2] = value[0::2, 1::2, 1], value[1::2, 0::2, 1]
    return own * full / 65535


def report(name, value, variance=None, rescale=False):
    value = np.asarray(value, float).reshape(levels, rows * width)
    lit = slice(0, levels - 2)
    scale = 1.0
    with np.errstate(all="ignore"):
        if rescale:
            scale = np.nanmedian(np.nanmedian(value[lit], 1) / truth[lit])
        value = value / scale
        error = value - truth[:, None]
        square, mean = np.nanmean(error**2, 1), np.nanmean(error, 1)
        lost = np.mean(~np.isfinite(value), 1)
    decade = np.minimum(np.floor(np.log10(truth[0] / truth[lit]) - 1e-9).astype(int).clip(0), 4)
    far = ~np.array(about["near_saturation"])[lit]

    def per_decade(f, form):
        return " / ".join(form.format(f([i for i in range(levels - 2) if decade[i] == d and far[i]])) for d in range(5))

    root = per_decade(lambda i: 100 * np.sqrt(np.nanmean(square[i] / truth[i] ** 2)), "{:.3g}")
    ratio = per_decade(lambda i: np.nanmean(square[i] / bound[i]), "{:.3g}")

    def largest(i):
        relative = 100 * mean[i] / truth[i]
        return np.nan if np.isnan(relative).all() else relative[np.nanargmax(np.abs(relative))]

    bias = per_decade(largest, "{:+.2g}")
    share = 100 * lost[lit].max()
    white = value[-2] / truth[-2]
    white = "masked" if variance is not None and np.isnan(white).all() else (
        "NaN" if np.isnan(white).all() else f"{np.nanmedian(white):.2g} of the truth")
    dark = value[-1]
    dark = "NaN" if np.isnan(dark).mean() > 0.5 else f"{np.nanmean(dark):+.3g} ± {np.nanstd(dark):.2g}"
    states = "no"
    if variance is not None:
        v = np.asarray(variance, float).reshape(levels, rows * width)
        ratios = np.array([np.nanmean(v[i][np.isfinite(value[i])]) for i in range(levels - 2)])[far] / square[lit][far]
        states = f"yes, {ratios.min():.2f} to {ratios.max():.2f} of the error"
    print(f"| {name} | {root} | {ratio} | {bias} | {states} | {share:.2g} % | {white} | {dark} |", flush=True)


print("| merge | RMSE, % of the truth, by decade from the brightest | MSE over the bound | largest bias, % |"
      " variance | NaN or masked | light that saturates all | no light, DN/s |")
print("|---|---|---|---|---|---|---|---|")
report("**acquire**", *ours())
report("Σy/Σt, unsaturated", photons())
report("longest unsaturated", longest())
report("hat weights", hat())
report("mean of y/t, 5 to 95 %", plain())
report("HDRutils 1.2", hdrutils())
for curved in (False, True):
    kind = "8-bit sRGB" if curved else "8-bit linear"
    report(f"OpenCV {cv2.__version__} Debevec, {kind}", opencv(cv2.createMergeDebevec, curved), rescale=True)
    report(f"OpenCV {cv2.__version__} Robertson, {kind}", opencv(cv2.createMergeRobertson, curved), rescale=True)
