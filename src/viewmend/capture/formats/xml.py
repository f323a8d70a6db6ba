"""XML of others, without what can make a small file large."""

import math
from xml.etree.ElementTree import Element, ParseError, fromstring


def read_xml(data: bytes) -> Element:
    """The root of an XML document.

    Raises:
        ValueError: it is no XML, or declares a document type, by which entities grow without end.
    """
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data:
        raise ValueError("expected XML without a document type, got one; export it again")
    try:
        return fromstring(data)
    except (ParseError, ValueError, LookupError) as error:
        raise ValueError(f"expected XML, got something else: {str(error)[:80]}; export it again") from None


def number(what: str, text: str | None) -> float:
    """A finite number as XML has it; `what` begins the message.

    Raises:
        ValueError: it is absent, or none.
    """
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{what}: expected a number, got {'nothing' if not text else repr(text[:40])}; add it")
    return value


def attributes(name: str, element: Element | None, keys: str) -> list[float]:
    """Numbers that an element of a camera has as attributes.

    Raises:
        ValueError: one is absent, or no number.
    """
    return [number(f"camera '{name}': {key}", None if element is None else element.get(key)) for key in keys.split()]
