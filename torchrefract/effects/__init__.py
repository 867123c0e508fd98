"""Effects: modules that draw parameters by key and compute a degradation from them.

To add one:

1. `fields/x.py`: the pure function, with its source.
2. `tests/fields/test_x.py`: property, reference, gradcheck.
3. `effects/x.py`: a params NamedTuple, then `draw`, `check` and `flow` or `shade`.
4. One line in `torchrefract/__init__.py`, one in the list of `tests/effects/test_contract.py`.
5. Where wanted, a function in `presets.py` and a file in `conf/scene/`.
"""
