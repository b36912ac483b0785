"""Which keywords a class takes, where its constructor passes what it does not know on to the one of the class before."""

import inspect


def constructor_keywords(kind: type) -> list[str]:
    """Names of all keywords of a class's constructor: its own and, where it ends in ``**options``, those of the next class in
    the order of inheritance that has a constructor, and so on; names that begin with an underscore are left out."""
    names: dict[str, None] = {}
    for base in kind.__mro__:
        if "__init__" not in vars(base):
            continue
        parameters = inspect.signature(base.__init__).parameters.values()  # type: ignore[misc]
        names |= {one.name: None for one in parameters if one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)}
        if not any(one.kind is one.VAR_KEYWORD for one in parameters):
            break
    return [name for name in names if name != "self" and not name.startswith("_")]
