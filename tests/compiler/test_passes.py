"""The compiler's passes."""

import inspect

from tgdsl.compiler import passes


def test_no_pass_is_a_generator():
    """An unconsumed generator would silently do nothing."""
    public = [value for name, value in vars(passes).items() if inspect.isfunction(value) and not name.startswith("_")]
    defined = [function for function in public if inspect.unwrap(function).__module__ == passes.__name__]
    assert {"prune", "join", "share", "rows_of", "number"} <= {function.__name__ for function in defined}
    assert not [function.__name__ for function in defined if inspect.isgeneratorfunction(inspect.unwrap(function))]
