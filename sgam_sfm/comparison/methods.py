"""What is compared: `area-matcher:point-matcher[@option=value,...]`, or `sift`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from sgam_core.errors import OptionError
from sgam_core.options import CropOptions
from sgam_sfm import registry
from sgam_sfm.options import MatchOptions, merged

SIFT = "sift"
_CROP = frozenset(option.name for option in fields(CropOptions))


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """One method of a comparison.

    name: as it was given. area_matcher: empty for COLMAP's own SIFT. same_budget: as many pixels are matched as SGAM
    matches with the same point matcher. options: further options of `match`, by flag, that this method alone has.
    """

    name: str
    area_matcher: str = ""
    matcher: str = ""
    same_budget: bool = False
    options: tuple[tuple[str, str], ...] = ()

    @property
    def slug(self) -> str:
        """A name for its folder, safe in every file system."""
        return re.sub(r"[^A-Za-z0-9._-]", "-", re.sub("[:@,]", "_", self.name))

    def applied(self, common: MatchOptions, output: Path, seed: int) -> MatchOptions:
        """The options of this method's run: the common ones with its own.

        Raises: OptionError for an option that `match` does not have, or a value of another type.
        """
        own = replace(common, area_matcher=self.area_matcher, matcher=self.matcher, output=output, seed=seed)
        try:
            changed: MatchOptions = merged(own, _nested(self.options))
        except OptionError as error:
            raise OptionError(f"method '{self.name}': {error}") from error
        return changed


def parse_methods(texts: Sequence[str]) -> tuple[Method, ...]:
    """The methods that a user named, in their order.

    Raises: OptionError for one that cannot be run, or named twice, or a budget that nothing sets.
    """
    methods = tuple(map(parse_method, texts))
    if not methods:
        raise OptionError("no method to compare; expected for example sgam:xfeat-star none:xfeat-star sift")
    slugs = [method.slug for method in methods]
    for method in methods:
        if slugs.count(method.slug) > 1:
            raise OptionError(f"method '{method.name}' is named twice (folder '{method.slug}')")
        if method.same_budget and budget_reference(methods, method) is None:
            raise OptionError(
                f"method '{method.name}' is to match as many pixels as SGAM does; name 'sgam:{method.matcher}' too"
            )
    return methods


def parse_method(text: str) -> Method:
    """One method. Raises: OptionError when it is none."""
    if text == SIFT:
        return Method(name=text)
    found = re.fullmatch(r"(?P<areas>[^:@]+):(?P<points>[^@]+)(@(?P<options>.+))?", text)
    if found is None:
        raise OptionError(
            f"method '{text}' cannot be understood; expected area-matcher:point-matcher[@option=value,...] or sift, "
            "for example none:xfeat-star@budget=match"
        )
    for kind, name in (("area-matcher", found["areas"]), ("matcher", found["points"])):
        try:
            registry.require(kind, name)
        except OptionError as error:
            raise OptionError(f"method '{text}': {error}") from error
    options: list[tuple[str, str]] = []
    for part in (found["options"] or "").split(",") if found["options"] else ():
        flag, separator, value = part.partition("=")
        if not separator or not flag or not value:
            raise OptionError(f"method '{text}': '{part}' is no option; expected option=value")
        options.append((flag.removeprefix("--"), value))
    budgets = [value for flag, value in options if flag == "budget"]
    if any(value != "match" for value in budgets):
        raise OptionError(f"method '{text}': budget is '{budgets[0]}'; expected match")
    return Method(
        name=text,
        area_matcher=found["areas"],
        matcher=found["points"],
        same_budget=bool(budgets),
        options=tuple((flag, value) for flag, value in options if flag != "budget"),
    )


def budget_reference(methods: Sequence[Method], method: Method) -> Method | None:
    """The method whose pixels set the budget of another one: SGAM with the same point matcher."""
    candidates = (m for m in methods if m.area_matcher == "sgam" and m.matcher == method.matcher)
    return next((m for m in candidates if not m.same_budget), None)


def _nested(options: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Flags such as `image-size` and `rejection.rule` as nested options."""
    nested: dict[str, Any] = {}
    for flag, value in options:
        path = flag.replace("-", "_").split(".")
        path = ["crop", *path] if path[0] in _CROP else path
        inner = nested
        for name in path[:-1]:
            inner = inner.setdefault(name, {})
        inner[path[-1]] = value
    return nested
