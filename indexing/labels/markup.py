"""XML that may be hostile: no document types, no entities, bounded depth and size; and where in the file each element stands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from indexing.opening import error

MAX_DEPTH = 64  # elements of an ELAN file inside each other: ELAN writes five
MAX_ELEMENTS = 20_000_000  # of an ELAN file: a million annotations take five million
REMEDY = "save it again in ELAN"
WORDED = frozenset(("ANNOTATION_VALUE", "CVE_VALUE", "CV_ENTRY", "PROPERTY"))
"""Elements whose text counts; that between others is indentation, and takes half of the memory."""


@dataclass(frozen=True)
class Placed:
    """An element and where it stands: ``data[first:last]``."""

    element: Element
    first: int
    last: int


Taken = Callable[[Placed, Element], bool]
"""What looks at each grandchild of the root, with its parent, as soon as it is read; True: the tree need not keep it."""


def parse_xml(path: Path, data: bytes, taken: Taken = lambda placed, parent: False) -> tuple[Element, list[Placed]]:
    """The root of a document, and where its children stand."""
    return _Parser(path, data, taken).parse()


class _Parser:
    """Expat, with a guard at every door."""

    def __init__(self, path: Path, data: bytes, taken: Taken) -> None:
        self.path = path
        self.data = data
        self.taken = taken
        self.elements = 0
        self.children: list[Placed] = []
        self.builder = TreeBuilder()
        self.open: list[tuple[Element, int]] = []
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = self.end
        self.parser.StartDoctypeDeclHandler = self.refuse
        self.parser.EntityDeclHandler = self.refuse
        self.parser.ExternalEntityRefHandler = self.refuse

    def parse(self) -> tuple[Element, list[Placed]]:
        try:
            self.parser.Parse(self.data, True)
            root: Element = self.builder.close()
        except expat.ExpatError as problem:
            message = f"is no sound XML at line {problem.lineno}, column {problem.offset + 1} ({expat.ErrorString(problem.code)})"
            raise error(self.path, message, REMEDY) from None
        except (LookupError, UnicodeError):  # an encoding that Python does not know
            raise error(self.path, "is XML in an unknown encoding", "save it in UTF-8") from None
        finally:  # handlers hold on to this object, and it to them
            self.parser.StartElementHandler = self.parser.EndElementHandler = None
        return root, self.children

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self.elements += 1
        if len(self.open) >= MAX_DEPTH:
            raise error(self.path, f"its XML has elements {len(self.open) + 1} deep", REMEDY)
        if self.elements > MAX_ELEMENTS:
            raise error(self.path, f"has more than {MAX_ELEMENTS:,} XML elements", "split it")
        self.open.append((self.builder.start(tag, attributes), self.parser.CurrentByteIndex))
        if tag in WORDED:
            self.parser.CharacterDataHandler = self.builder.data

    def end(self, tag: str) -> None:
        if tag in WORDED:
            self.parser.CharacterDataHandler = None
        self.builder.end(tag)
        element, first = self.open.pop()
        depth = len(self.open)
        if depth == 1:
            self.children.append(Placed(element, first, self.last(first, self.parser.CurrentByteIndex)))
        elif depth == 2:
            parent = self.open[-1][0]
            if self.taken(Placed(element, first, self.last(first, self.parser.CurrentByteIndex)), parent):
                del parent[-1]

    def last(self, first: int, at: int) -> int:
        """Where an element ends that begins here: of ``<A/>`` expat says so itself, of ``<A></A>`` where the closing tag begins."""
        if self.data[at - 2 : at] == b"/>" and (at == self.data.find(b">", first) + 1 or at == self.find_tag_end(first)):
            return at
        return self.data.index(b">", at) + 1

    def find_tag_end(self, first: int) -> int:
        """The end of a tag that begins here; ``>`` may stand in its attributes."""
        quote = 0
        for at in range(first, len(self.data)):
            byte = self.data[at]
            if quote:
                quote = 0 if byte == quote else quote
            elif byte in b"\"'":
                quote = byte
            elif byte == ord(">"):
                return at + 1
        raise error(self.path, "is no sound XML", REMEDY)

    def refuse(self, *_: Any) -> Any:
        raise error(self.path, "its XML declares a document type or entities", REMEDY)
