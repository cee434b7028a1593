"""Which message types there are: loaded once per name, and those a publisher's text brought along."""

import os
from collections.abc import Callable
from threading import RLock
from weakref import WeakValueDictionary

from uorb_net.errors import DefinitionError, UnknownTopicError
from uorb_net.messages.grammar import Definition, camel_case, is_message_name, parse
from uorb_net.messages.schema import Schema, resolve, split_full_text
from uorb_net.messages.searchpath import SearchPath, Source, shipped_directory
from uorb_net.messages.typehash import type_hash
from uorb_net.messages.types import Message, build


class Registry:
    """Message types by name and by topic; safe to use from several threads."""

    def __init__(self, shipped: str | None = None) -> None:
        """Use the definitions of the search path, ``shipped`` being the last directory of it."""
        self._path = SearchPath(shipped_directory() if shipped is None else shipped)
        self._lock = RLock()
        self._types: dict[str, type[Message]] = {}
        self._by_topic: dict[str, type[Message]] = {}
        # Weak: a peer may send texts without end, and nothing else keeps those types.
        self._foreign: WeakValueDictionary[tuple[str, str], type[Message]] = WeakValueDictionary()
        self._texts: WeakValueDictionary[tuple[str, str], type[Message]] = WeakValueDictionary()

    def add_path(self, directory: str | os.PathLike[str]) -> None:
        """Search a directory and those below it, after the ones added before, before all others.

        Names that are loaded already stay what they are.

        Raises:
            NotADirectoryError: there is no such directory.
        """
        path = os.path.abspath(os.fspath(directory))
        if not os.path.isdir(path):
            raise NotADirectoryError(f"no directory of message definitions: {path}")
        with self._lock:
            self._path.add(path)

    def load(self, name: str) -> type[Message]:
        """Return the class of a message, given by its CamelCase name or by one of its topics.

        Raises:
            UnknownTopicError: there is no definition of that name.
            DefinitionError: there is one, but it cannot be used.
        """
        found = self._types.get(name)
        if found is not None:
            return found
        if not name[:1].isupper():
            return self.type_for_topic(name)
        with self._lock:
            return self._load(name)

    def type_for_topic(self, topic: str) -> type[Message]:
        """Return the class of a topic's messages.

        Raises:
            UnknownTopicError: no definition has that topic; similar names are suggested.
            DefinitionError: the definition that has it cannot be used.
        """
        found = self._by_topic.get(topic)
        if found is None:
            with self._lock:
                found = self._by_topic[topic] = self._find_topic(topic)
        return found

    def names(self) -> list[str]:
        """Return the names of all messages on the search path, sorted.

        File names are looked at, not texts: a name whose definition is bad is listed, and ``load`` says why.
        """
        with self._lock:
            return sorted({*self._path.sources(), *self._types})

    def topics(self) -> list[str]:
        """Return the names of all topics, sorted."""
        with self._lock:
            found = {topic for cls in self._types.values() for topic in cls.__uorb__.topics}
            for source in self._path.sources().values():
                if source.name not in self._types:
                    found.update(self._path.topics(source))
            return sorted(found)

    def definition(self, name: str) -> str:
        """Return the definition's text of a message or topic, as it was read; also a bad one's.

        Raises:
            UnknownTopicError: there is none of that name.
        """
        with self._lock:
            if not name[:1].isupper() and name in self._by_topic:
                return self._by_topic[name].__uorb__.definition
            if name in self._types:
                return self._types[name].__uorb__.definition
            source = self._path.find(name) if name[:1].isupper() else self._path.find_topic(name)
            if source is None:
                raise self._unknown(name)
            return source.read()

    def type_hash(self, name: str) -> str:
        """Return the RIHS01 hash of a message or topic; raises as ``load`` does."""
        return self.load(name).__uorb__.type_hash

    def from_text(self, name: str, full_definition: str) -> type[Message]:
        """Return the class for a publisher's self-contained text, without registering it.

        Where the search path has a type of that name and hash it is that one; else one per hash.

        Raises:
            DefinitionError: the text cannot be used.
        """
        key = (camel_case(name), full_definition)
        with self._lock:
            found = self._texts.get(key)
            if found is None:
                found = self._texts[key] = self._adopt(_schema_of_text(*key))
            return found

    def _load(self, name: str) -> type[Message]:
        if name in self._types:
            return self._types[name]
        definition = self._definition(name)
        if definition is None:
            raise self._unknown(name)
        return self._register(resolve(definition, self._lookup))

    def _definition(self, name: str) -> Definition | None:
        source = self._path.find(name) if is_message_name(name) else None
        return None if source is None else _parse(source)

    def _lookup(self, name: str) -> Schema | Definition | None:
        loaded = self._types.get(name)
        return self._definition(name) if loaded is None else loaded.__uorb__.schema

    def _register(self, schema: Schema) -> type[Message]:
        if schema.name not in self._types:
            self._types[schema.name] = _built(schema, self._register)
        return self._types[schema.name]

    def _find_topic(self, topic: str) -> type[Message]:
        source = self._path.find_topic(topic)
        if source is None:
            self._path.refresh()
            source = self._path.find_topic(topic)
        loaded = [self._load(source.name)] if source is not None else []
        for cls in (*loaded, *self._types.values()):
            if topic in cls.__uorb__.topics:
                return cls
        raise self._unknown(topic)

    def _adopt(self, schema: Schema) -> type[Message]:
        """Return the class of a schema that is not from the search path."""
        key = (schema.name, type_hash(schema))
        if key[1] == self._own_hash(schema.name):
            return self._load(schema.name)
        found = self._foreign.get(key)
        if found is None:
            found = self._foreign[key] = _built(schema, self._adopt)
        return found

    def _own_hash(self, name: str) -> str | None:
        """Return the hash of the search path's definition, without loading it; None if there is none."""
        try:
            found = self._lookup(name)
            if isinstance(found, Definition):
                found = resolve(found, self._lookup)
        except DefinitionError:
            return None
        return None if found is None else type_hash(found)

    def _unknown(self, name: str) -> UnknownTopicError:
        from difflib import get_close_matches

        message = name[:1].isupper()
        near = get_close_matches(name, self.names() if message else self.topics())
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        return UnknownTopicError(f"no {'message' if message else 'topic'} {name!r} is defined{hint}")


def _built(schema: Schema, nested: Callable[[Schema], type[Message]]) -> type[Message]:
    own = [member.nested for member in schema.members if member.nested is not None]
    return build(schema, {inner.name: nested(inner) for inner in own})


def _parse(source: Source) -> Definition:
    return parse(source.name, source.read(), source.path, source.topic)


def _schema_of_text(name: str, text: str) -> Schema:
    if not is_message_name(name):
        raise DefinitionError(name, 0, "no name of a message")
    texts = split_full_text(name, text)

    def lookup(nested: str) -> Definition | None:
        return parse(nested, texts[nested]) if nested in texts else None

    return resolve(parse(name, texts[name]), lookup)
