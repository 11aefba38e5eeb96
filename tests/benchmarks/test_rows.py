"""The benchmark of large files: its segmented image has the bodies that it names."""

import numpy as np
import pytest

from benchmarks.rows import IMAGE_MM, SLICE_PIXELS, Cost, markdown, write_image

nibabel = pytest.importorskip("nibabel", reason="the extra 'segmentation' is not installed")


def test_the_segmented_image_has_an_organ_a_lesion_and_a_vessel(tmp_path):
    image = nibabel.load(write_image(20, tmp_path))
    labels = np.asarray(image.dataobj)
    spacing = image.header.get_zooms()
    assert labels.shape == (SLICE_PIXELS, SLICE_PIXELS, 20)
    np.testing.assert_allclose(np.multiply(spacing, labels.shape), [IMAGE_MM[0], *IMAGE_MM])
    litres = np.bincount(labels.ravel()) * np.prod(spacing) / 1e6
    assert litres[1:].sum() == pytest.approx(4.0 / 3.0 * np.pi * 1.00 * 0.62 * 0.62, rel=0.02)
    assert litres[2] == pytest.approx(4.0 / 3.0e3 * np.pi, rel=0.2)  # slices of 15 mm
    assert litres[3] > 0.01
    assert not labels[[0, -1]].any()
    assert not labels[:, :, [0, -1]].any()


def test_the_table_has_the_time_on_the_clock_and_errors():
    fine = Cost("scene new IMAGE", 200, 13.9, 14.4, 0.87, "2 min", "")
    bad = Cost("scene new IMAGE", 200, 1.0, 1.0, 0.1, "2 min", "exit 2: no memory")
    lines = markdown([fine, bad]).splitlines()
    assert lines[-2].endswith("| 200 | 13.90 s | 14.40 s | 0.87 GB | 2 min |")
    assert lines[-1].endswith("| 200 | exit 2: no memory | - | - | 2 min |")
    assert len({line.count("|") for line in lines[2:]}) == 1
