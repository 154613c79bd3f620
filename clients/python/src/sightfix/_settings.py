"""How a server is reached."""

import os
import ssl
from dataclasses import dataclass, field
from pathlib import Path

from sightfix._errors import ProblemError
from sightfix._request import RetryPolicy

KEY_VARIABLE = "SIGHTFIX_API_KEY"
DEFAULT_SERVER = "http://127.0.0.1:8080"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Address, credentials and limits of a client."""

    server: str
    api_key: str | None = field(repr=False)
    ca_file: Path | None
    certificate_file: Path | None
    key_file: Path | None
    timeout_s: float
    retry: RetryPolicy

    def headers(self) -> dict[str, str]:
        """Headers of every request."""
        return {"authorization": f"Bearer {self.api_key}"} if self.api_key else {}

    def node_of(self, failure: ProblemError | None) -> str:
        """Where to go on after a failure: the node that the server names, which never costs the encryption."""
        owner = failure.problem.owner if failure else None
        is_plain = self.server.startswith("http:")
        return owner if owner and (is_plain or owner.startswith("https:")) else self.server

    def tls_context(self) -> ssl.SSLContext:
        """Verifies the server by the given authority, or by those of the system."""
        context = ssl.create_default_context(cafile=self.ca_file)
        if self.certificate_file is not None:
            context.load_cert_chain(self.certificate_file, self.key_file)
        return context


def settings(
    server: str,
    *,
    api_key: str | None,
    ca_file: str | Path | None,
    certificate_files: tuple[str | Path, str | Path] | None,
    timeout_s: float,
    retry: RetryPolicy | None,
) -> Settings:
    """The settings of a client from its arguments and the environment.

    Raises:
        ValueError: The address does not begin with http:// or https://.
    """
    if not server.startswith(("http://", "https://")):
        raise ValueError(f"the address of the server must begin with http:// or https://, not {server!r}")
    certificate_file, key_file = map(Path, certificate_files) if certificate_files else (None, None)
    return Settings(
        server=server.rstrip("/"),
        api_key=api_key or os.environ.get(KEY_VARIABLE),
        ca_file=Path(ca_file) if ca_file else None,
        certificate_file=certificate_file,
        key_file=key_file,
        timeout_s=timeout_s,
        retry=retry or RetryPolicy(),
    )
