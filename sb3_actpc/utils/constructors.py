"""Which keywords a class takes, where its constructor passes what it does not know on to the one of the class before."""

import inspect
from collections.abc import Callable, Iterator


def constructors(kind: type) -> Iterator[Callable[..., None]]:
    """A class's constructor and, where it ends in ``**options``, that of the next class in the order of inheritance, and so
    on."""
    for base in kind.__mro__:
        if "__init__" not in vars(base):
            continue
        init = vars(base)["__init__"]
        yield init
        if not any(one.kind is one.VAR_KEYWORD for one in inspect.signature(init).parameters.values()):
            return


def constructor_keywords(kind: type) -> list[str]:
    """Names of all keywords of a class's :func:`constructors`; those that begin with an underscore are left out."""
    parameters = [one for init in constructors(kind) for one in inspect.signature(init).parameters.values()]
    names = dict.fromkeys(one.name for one in parameters if one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL))
    return [name for name in names if name != "self" and not name.startswith("_")]
