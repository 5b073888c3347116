"""Writes a rosbag2 recording message by message: whole at its end, and salvageable before."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.files import check_above, sync_folder
from nics_drl_bridge.kinematics.bag_messages import typestore
from nics_drl_bridge.kinematics.bag_qos import Offer, profile_of
from nics_drl_bridge.kinematics.mcap_records import seal

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer

Storage = Literal["mcap", "sqlite3"]

NO_HASH = f"RIHS01_{'0' * 64}"
"""Of a type that is known by its text alone."""
CHUNK_BYTES = 1 << 16
"""A damage costs the chunk that it is in, because a checksum is of a whole chunk."""


class BagSink:
    """An open bag; `bag_sink` makes it.

    Args:
        writer: of rosbags, open.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer, self._store = writer, typestore()
        self._connections: dict[str, Connection] = {}
        self.counts: dict[str, int] = {}

    def add_topic(
        self,
        topic: str,
        kind: str,
        offers: Sequence[Offer] = (),
        texts: Mapping[str, str] | None = None,
        definition: str | None = None,
    ) -> None:
        """Begins a topic.

        Args:
            topic: its name.
            kind: type of its messages, as `nav_msgs/msg/Odometry`.
            offers: of its publishers.
            texts: the `.msg` texts of the type and of what it is made of, where rosbags does
                not know it.
            definition: whole definition of the type as a bag keeps it, instead.
        """
        if kind not in self._store.fielddefs and texts:
            self._register(texts)
        known = kind in self._store.fielddefs
        given = {} if known else {"msgdef": definition or "", "rihs01": NO_HASH}
        self._connections[topic] = self._writer.add_connection(
            topic, kind, typestore=self._store, **given,
            offered_qos_profiles=[profile_of(offer) for offer in offers],
        )  # fmt: skip
        self.counts[topic] = 0

    def _register(self, texts: Mapping[str, str]) -> None:
        from rosbags.typesys import get_types_from_msg

        for name, text in texts.items():
            if name not in self._store.fielddefs:
                self._store.register(get_types_from_msg(text, name))

    def write(self, topic: str, receive_ns: int, data: bytes) -> None:
        """Writes a serialized message."""
        self._writer.write(self._connections[topic], receive_ns, data)
        self.counts[topic] += 1
        storage: Any = self._writer.storage
        if hasattr(storage, "close_chunk") and storage.chunk.bio.tell() > CHUNK_BYTES:
            storage.close_chunk()

    def flush(self) -> None:
        """Puts on disk what was written, so that no crash of this process loses it."""
        storage: Any = self._writer.storage
        if hasattr(storage, "close_chunk"):
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()
        else:
            storage.conn.commit()


@contextmanager
def bag_sink(path: str | Path, storage: Storage = "mcap") -> Iterator[BagSink]:
    """Gives a bag to write into, which stands at `path` when the block ends well.

    It is written into a hidden folder `.NAME.*` beside it. After an error nothing is left; a
    killed process or a full disk leaves that folder, from which `salvage` saves what was flushed.

    Args:
        path: folder to make.
        storage: format of the file in the folder. MCAP carries checksums, so that any damage is
            found; SQLite has none.

    Raises:
        RecordingError: the folder is there already, or rosbags is not installed.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError:
        raise RecordingError(
            f"{path}: writing a bag needs the library rosbags; install it with "
            "pip install 'nics_drl_bridge[bags]'."
        ) from None
    path = Path(path)
    if path.exists():
        raise RecordingError(f"{path}: is there already; give the name of a new folder.")
    check_above(path)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    unfinished = beside / path.name
    try:
        with Writer(unfinished, version=8, storage_plugin=plugin) as writer:
            yield BagSink(writer)
        if storage == "mcap":
            seal(unfinished / f"{path.name}.mcap")
        sync_folder(unfinished)
        if path.exists():
            raise RecordingError(f"{path}: was made meanwhile; give the name of a new folder.")
        os.rename(unfinished, path)
    except OSError as error:
        raise RecordingError(
            f"{path}: {error.strerror or error}; what was written until then lies in {unfinished}, "
            "save it with `nics bag salvage` where there is room."
        ) from None
    except BaseException:
        _remove(beside)
        raise
    _remove(beside)


def _remove(folder: Path) -> None:
    for file in sorted(folder.rglob("*"), reverse=True):
        file.rmdir() if file.is_dir() else file.unlink()
    folder.rmdir()
