"""Packages that only a part of the users needs."""

import sys

import pytest

from sb3_actpc.utils import extras


@pytest.mark.parametrize("version", [(3, 12, 9), (3, 13, 0)])
def test_what_is_missing_says_how_to_install_it_and_from_which_python(monkeypatch, version):
    """The extra leaves robosuite out where it cannot be installed."""
    monkeypatch.setitem(sys.modules, "robosuite", None)
    monkeypatch.setattr(extras.sys, "version_info", version)
    with pytest.raises(ImportError, match=r'pip install "sb3-actpc\[robosuite\]"') as error:
        extras.import_extra("robosuite", "robosuite")
    assert ("from Python 3.12 or older" in str(error.value)) == (version == (3, 13, 0))
