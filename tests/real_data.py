"""Where tests find real data sets: the folder named by the environment variable FLEET_SEIF_DATA.

It holds mrclam/MRCLAM_Dataset<n>/ (unpacked) or mrclam/MRCLAM_Dataset<n>.tar.xz (unpacked once a session, to
pytest's temporary folder). The data are not part of the repository: their licence is not stated.
"""

import os
import tarfile
from pathlib import Path

import pytest

VARIABLE = "FLEET_SEIF_DATA"


def mrclam(number: int, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one MR.CLAM data set; skips the test, saying why, if there is none."""
    name = f"MRCLAM_Dataset{number}"
    root = os.environ.get(VARIABLE)
    if not root:
        pytest.skip(f"{name} not tested: set {VARIABLE} to the folder that contains mrclam/{name}.tar.xz")
    unpacked = Path(root) / "mrclam" / name
    if unpacked.is_dir():
        return unpacked
    archive = unpacked.with_name(f"{name}.tar.xz")
    if not archive.is_file():
        pytest.skip(f"{name} not tested: neither {unpacked} nor {archive} exists ({VARIABLE}={root})")
    target = tmp_path_factory.getbasetemp() / "mrclam"
    if not (target / name).is_dir():
        with tarfile.open(archive) as tar:
            tar.extractall(target, filter="data")
    return target / name
