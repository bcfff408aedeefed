"""Archives changed from outside, with the checksum left as it was or made to fit."""

import json

import numpy as np

from mjx_grasp.records.archive import checksum


def rewrite(path, change, sign=False):
    """Changes an archive by a function of (arrays, header).

    Args:
        path: The file.
        change: Works in place.
        sign: Whether the checksum is made to fit.
    """
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    header = json.loads(str(arrays.pop("header")))
    change(arrays, header)
    if sign:
        header["checksum"] = checksum(header, arrays)
    np.savez(path, header=np.array(json.dumps(header)), **arrays)
