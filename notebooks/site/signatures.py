"""Extension of Griffe: signatures of the package as users call it.

The reference is made from the source, without importing it. Two things are added to it here: the
constructors of `equinox.Module`s without `__init__`, and the quotation marks of jaxtyping's axes.
"""

import griffe

class Signatures(griffe.Extension):
    """Adds constructors to classes that have fields and no `__init__`."""

    def on_package(self, *, pkg, **kwargs):
        for cls in _classes(pkg):
            bases = _bases(cls)
            # Users do not construct results or base classes.
            if "AbstractResult" in bases or cls.name.startswith("Abstract"):
                continue
            if cls.docstring and cls.docstring.value.startswith("Result of"):
                continue
            if bases & {"Module", "NamedTuple"} and "__init__" not in cls.all_members:
                cls.set_member("__init__", _constructor(cls))


def _classes(parent):
    for member in list(parent.members.values()):
        if member.is_alias:
            continue
        if member.is_class:
            yield member
        elif member.is_module:
            yield from _classes(member)


def _bases(cls):
    """Return the names of the bases of a class and of its bases in the package."""
    return {
        str(base).rsplit(".", 1)[-1].split("[")[0]
        for owner in [cls, *cls.mro()]
        for base in owner.bases
    }


def _constructor(cls):
    """Return an `__init__` with the fields of a class as parameters."""
    parameters = [griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)]
    for owner in [*reversed(cls.mro()), cls]:
        for field in owner.members.values():
            if not field.is_attribute or field.annotation is None or field.name.startswith("_"):
                continue
            if "class-attribute" in field.labels and "instance-attribute" not in field.labels:
                continue
            if "ClassVar" in str(field.annotation) or field.name in {p.name for p in parameters}:
                continue
            parameters.append(
                griffe.Parameter(
                    field.name,
                    annotation=field.annotation,
                    kind=griffe.ParameterKind.positional_or_keyword,
                    default=_default(field.value),
                )
            )
    return griffe.Function("__init__", parameters=griffe.Parameters(*parameters), parent=cls)


def _default(value):
    """Return the default of a field: its value, or the argument `default` of `eqx.field`."""
    if isinstance(value, griffe.ExprCall) and str(value.function).endswith("field"):
        for argument in value.arguments:
            if isinstance(argument, griffe.ExprKeyword) and argument.name == "default":
                return argument.value
        return None
    return value
