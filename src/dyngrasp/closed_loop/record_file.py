"""Files of what happened: named arrays and a header of everything else, in one compressed .npz file."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dyngrasp.errors import InputFileError

# numpy keeps no text beside its arrays; this entry holds the header, as JSON.
_HEADER = "header"


@dataclass(frozen=True)
class RecordFormat:
    """One kind of such files.

    Attributes:
        name: Under which the header knows it.
        version: Of its content; files of others are refused.
        content: What it is, for messages, such as "a record of an episode".
    """

    name: str
    version: int
    content: str

    def write(self, path: str | Path, header: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
        """Write a file, exactly at `path`.

        Args:
            path: Where.
            header: What JSON can hold, finite numbers only; name and version are added.
            arrays: By name; none of them is called "header".
        """
        document = {"format": self.name, "version": self.version, **header}
        text: dict[str, Any] = {_HEADER: np.array(json.dumps(document, allow_nan=False))}
        # Through an open file, for numpy would append .npz to a name that lacks it.
        with Path(path).open("wb") as file:
            np.savez_compressed(file, **text, **arrays)

    @contextmanager
    def opened(self, path: str | Path) -> Iterator[tuple[dict[str, Any], Mapping[str, Any]]]:
        """Header and arrays of a file, open inside the `with` block; nothing in the file is executed.

        What the block itself finds wrong with them is reported as the reading is.

        Raises:
            InputFileError: The file is missing or of another kind or version, or something is missing from it.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                header = json.loads(str(archive[_HEADER]))
                if header.get("format") != self.name or header.get("version") != self.version:
                    expected = f"must be {self.name!r}, version {self.version}"
                    raise InputFileError(path, "format", header.get("format"), expected)
                yield header, archive
        except OSError as error:
            raise InputFileError(path, None, None, f"cannot be read: {error.strerror or error}") from error
        except KeyError as error:
            raise InputFileError(path, str(error.args[0]), None, "is missing from the record") from error
        except (ValueError, TypeError, AttributeError, zipfile.BadZipFile) as error:
            raise InputFileError(path, None, None, f"is not {self.content}: {error}") from error
