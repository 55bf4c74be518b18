"""A log in several files, of which each begins where the one before ends."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from drivers.logs.image_log import ImageLog, LogDamage, LoggedImage, LoggedMotion, images_of


class SplitLog:
    """An ImageLog of parts, which it closes."""

    def __init__(self, name: str, parts: Sequence[ImageLog]) -> None:
        """parts: in the order of time."""
        self.name = name
        self._parts = parts

    def topics(self) -> Mapping[str, str]:
        """Return name -> type of the topics of all parts."""
        found: dict[str, str] = {}
        for part in self._parts:
            for name, kind in part.topics().items():
                found[name] = found.get(name) or kind
        return found

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic; None where a part does not state it."""
        total = Counter[str]()
        for part in self._parts:
            counts = part.counts()
            if counts is None:
                return None
            total.update(counts)
        return total

    def images(self) -> Iterator[LoggedImage]:
        """Yield the images among the messages."""
        return images_of(self)

    def messages(self) -> Iterator[LoggedImage | LoggedMotion]:
        """Yield the messages of one part after the other."""
        for part in self._parts:
            yield from part.messages()

    def attachments(self) -> dict[str, bytes]:
        """Return the attachments of the first part that has some."""
        return next((found for found in (part.attachments() for part in self._parts) if found), {})

    def damage(self) -> LogDamage:
        """Return the faults of all parts."""
        found = [part.damage() for part in self._parts]
        cut = "; ".join(damage.cut for damage in found if damage.cut)
        return LogDamage(sum(damage.broken for damage in found), cut)

    def close(self) -> None:
        """Close all parts."""
        for part in self._parts:
            part.close()
