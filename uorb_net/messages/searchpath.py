"""Where ``.msg`` files are found: added directories, ``$UORB_MSG_PATH``, the shipped set, in this order.

Directories are walked when first needed; a file is read only when its message or its topics are asked for.
"""

import os
from collections.abc import Iterator

import msgspec

from uorb_net.errors import DefinitionError
from uorb_net.messages.grammar import camel_case, is_message_name, snake_case, topics_in

VARIABLE = "UORB_MSG_PATH"
SUFFIX = ".msg"


class Source(msgspec.Struct, frozen=True):
    """A definition file: the message it defines, and its topic where it lists none."""

    name: str
    path: str
    topic: str

    def read(self) -> str:
        """Return the text.

        Raises:
            DefinitionError: the file cannot be read.
        """
        try:
            with open(self.path, "rb") as file:
                # Only comments hold anything but ASCII; an odd byte in one is no reason to refuse the file.
                return file.read().decode("utf-8-sig", "replace")
        except OSError as error:
            raise DefinitionError(self.path, 0, f"cannot be read: {error.strerror}") from error


def shipped_directory() -> str:
    """Return the directory of the set that comes with the package: in a wheel, else in the checkout."""
    package = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    inside = os.path.join(package, "_msg")
    return inside if os.path.isdir(inside) else os.path.join(os.path.dirname(package), "msg")


class SearchPath:
    """The directories in force and what has been found in them. Not thread safe by itself."""

    def __init__(self, shipped: str) -> None:
        self._shipped = shipped
        self._added: list[str] = []
        self._found: dict[str, dict[str, Source]] = {}
        self._topics: dict[str, tuple[tuple[int, int], list[str]]] = {}

    def add(self, directory: str) -> None:
        """Append a directory behind those added before."""
        if directory not in self._added:
            self._added.append(directory)

    def directories(self) -> list[str]:
        """Return the directories in order of precedence; the environment is read anew each time."""
        variable = os.environ.get(VARIABLE, "")
        return [*self._added, *(part for part in variable.split(os.pathsep) if part), self._shipped]

    def refresh(self) -> None:
        """Forget which files there are."""
        self._found.clear()

    def find(self, name: str) -> Source | None:
        """Return the file of a message; a file made since the last walk is found too."""
        return self._find(name) or self._again(name)

    def sources(self) -> dict[str, Source]:
        """Return the file of each message name, as they are now."""
        self.refresh()
        return {source.name: source for _, source in self._visible()}

    def find_topic(self, topic: str) -> Source | None:
        """Return the file whose message has a topic.

        Within a directory a message of the topic's own name comes first: then no other file is read.
        """
        own = camel_case(topic)
        for directory in self.directories():
            sources = self._walked(directory)
            first = [sources[own]] if own in sources else []
            for source in (*first, *sources.values()):
                if self._find(source.name) is source and topic in self.topics(source):
                    return source
        return None

    def topics(self, source: Source) -> list[str]:
        """Return a file's topics by its ``# TOPICS`` lines, without parsing the rest; none if it is gone."""
        try:
            status = os.stat(source.path)
            state = (status.st_mtime_ns, status.st_size)
            if self._topics.get(source.path, (None,))[0] != state:
                self._topics[source.path] = (state, topics_in(source.read()) or [source.topic])
        except (OSError, DefinitionError):
            return []
        return self._topics[source.path][1]

    def _find(self, name: str) -> Source | None:
        for directory in self.directories():
            if name in (sources := self._walked(directory)):
                return sources[name]
        return None

    def _again(self, name: str) -> Source | None:
        self.refresh()
        return self._find(name)

    def _visible(self) -> Iterator[tuple[str, Source]]:
        """Yield each message's file that wins, with its directory."""
        seen: set[str] = set()
        for directory in self.directories():
            for name, source in self._walked(directory).items():
                if name not in seen:
                    seen.add(name)
                    yield directory, source

    def _walked(self, directory: str) -> dict[str, Source]:
        if directory not in self._found:
            found: dict[str, Source] = {}
            for source in _walk(directory):
                found.setdefault(source.name, source)
            self._found[directory] = found
        return self._found[directory]


def _walk(directory: str) -> Iterator[Source]:
    """Yield the definition files below a directory, upper levels first, in the order of their names."""
    for path, folders, files in os.walk(directory):
        folders[:] = sorted(folder for folder in folders if not folder.startswith("."))
        for file in sorted(files):
            stem, suffix = os.path.splitext(file)
            name = camel_case(stem)
            if suffix == SUFFIX and is_message_name(name):
                topic = stem if stem.islower() else snake_case(name)
                yield Source(name, os.path.join(path, file), topic)
