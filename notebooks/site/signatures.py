"""Extension of Griffe: signatures of the package as users call it.

The reference is made from the source, without importing it. This extension

- adds the constructors that equinox and `NamedTuple` derive from fields,
- leaves out private parameters of constructors,
- writes the axes of arrays as strings. Griffe reads some as expressions, for instance "d *lanes".
"""

import ast
import dataclasses
import re

import griffe

_ARRAYS = {"Array", "Bool", "Float", "Inexact", "Int", "Key", "Num"}


class Signatures(griffe.Extension):
    """Extension that corrects signatures."""

    def on_package(self, *, pkg, **kwargs):
        for member in _members(pkg):
            if member.is_class:
                _correct_constructor(member)
        for member in _members(pkg):
            if member.is_function:
                for parameter in member.parameters:
                    _write_axes(parameter.annotation)
                _write_axes(member.returns)
            elif member.is_attribute:
                _write_axes(member.annotation)


def _members(parent):
    """Yield all objects of a package."""
    for member in list(parent.members.values()):
        if not member.is_alias:
            yield member
            if member.is_module or member.is_class:
                yield from _members(member)


def _correct_constructor(cls):
    if "__init__" in cls.members:
        written = cls.members["__init__"].parameters
        public = [parameter for parameter in written if parameter.name[0] != "_"]
        cls.members["__init__"].parameters = griffe.Parameters(*public)
    bases = {
        str(base).rsplit(".", 1)[-1].split("[")[0]
        for owner in [cls, *cls.mro()]
        for base in owner.bases
    }
    # Users do not construct results or base classes.
    summary = cls.docstring.value.split("\n\n")[0] if cls.docstring else ""
    if re.search(r"Result of|from `", summary) or cls.name.startswith("Abstract"):
        return
    if "AbstractResult" in bases or "__init__" in cls.all_members:
        return
    if bases & {"Module", "NamedTuple"}:
        cls.set_member("__init__", _constructor(cls))


def _constructor(cls):
    """Return an `__init__` with the fields of a class as parameters."""
    names = {}
    for owner in [*reversed(cls.mro()), cls]:
        for field in owner.members.values():
            if field.is_attribute and field.annotation is not None and _is_field(field):
                names[field.name] = griffe.Parameter(
                    field.name,
                    annotation=field.annotation,
                    kind=griffe.ParameterKind.positional_or_keyword,
                    default=_default(field.value),
                )
    this = griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)
    return griffe.Function(
        "__init__", parameters=griffe.Parameters(this, *names.values()), parent=cls
    )


def _is_field(attribute):
    # Griffe removes `ClassVar` and leaves a label.
    of_class = {"class-attribute", "instance-attribute"} & attribute.labels == {"class-attribute"}
    abstract = "Abstract" in str(attribute.annotation) and "Var" in str(attribute.annotation)
    return not (
        of_class or abstract or "property" in attribute.labels or attribute.name.startswith("_")
    )


def _default(value):
    """Return the default of a field: its value, or the argument `default` of `eqx.field`."""
    if isinstance(value, griffe.ExprCall) and str(value.function).endswith("field"):
        keywords = [part for part in value.arguments if isinstance(part, griffe.ExprKeyword)]
        return next((part.value for part in keywords if part.name == "default"), None)
    return value


def _write_axes(expression):
    """Write `Float[Array, d * lanes]` as `Float[Array, "d *lanes"]`, within any expression."""
    if isinstance(expression, list):
        for part in expression:
            _write_axes(part)
    if not isinstance(expression, griffe.Expr):
        return
    if isinstance(expression, griffe.ExprSubscript) and str(expression.left) in _ARRAYS:
        if isinstance(expression.slice, griffe.ExprTuple):
            elements = expression.slice.elements
            elements[1] = griffe.ExprConstant(f'"{_axes(str(elements[1]))}"')
            return
    for field in dataclasses.fields(expression):
        if field.name != "parent":
            _write_axes(getattr(expression, field.name))


def _axes(text):
    if text[0] in "'\"":
        text = ast.literal_eval(text)
    return text.strip().replace(" * ", " *")
