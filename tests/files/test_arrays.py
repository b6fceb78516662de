import numpy as np
import pytest

from tgdsl.errors import StateError
from tgdsl.files.arrays import read_arrays


def test_other_arrays_are_not_read(tmp_path):
    file = tmp_path / "a.npz"
    np.savez(file, small=np.arange(3), pickled=np.array([None]))
    with pytest.raises(StateError, match=r"expected a run: .*allow_pickle"):
        read_arrays(file, "a run", StateError)
    arrays = read_arrays(file, "a run", only=("small", "absent"))
    assert arrays.keys() == {"small"} and arrays["small"].tolist() == [0, 1, 2]
