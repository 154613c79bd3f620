"""Memory that one hostile request makes a server take, per byte received: the table of docs/explanation/reliability.md.

Usage: SIGHTFIX=target/debug/sightfix python benches/peers/amplification.py [part of a case's name]
Needs curl with HTTP/2, and Linux (VmHWM). Each case has a server of its own.
"""

import os
import re
import struct
import subprocess
import sys
import tempfile
import time

MODEL = os.path.join(os.path.dirname(__file__), "../../models/demo-square.safetensors")
LARGE, SMALL = 4_180_000, 1 << 20
JSON = "application/json"


def field(number: int, content: bytes) -> bytes:
    """A field of bytes in the wire format of protobuf."""
    length, header = len(content), bytes([number << 3 | 2])
    while length > 127:
        header += bytes([length & 127 | 128])
        length >>= 7
    return header + bytes([length]) + content


def many(item: bytes, size: int) -> bytes:
    return b",".join([item] * ((size - 200) // (len(item) + 1)))


def tensor(contents: bytes) -> bytes:
    return field(1, b"c") + field(5, field(1, b"boxes") + field(2, b"FP64") + field(5, contents))


LABELS = b",".join(b'"%d":""' % number for number in range((SMALL - 100) // 11))
INFER = b'{"inputs":[{"name":"boxes","shape":[1,4],"datatype":"FP64","data":[%b]}]}'
CASES = [
    ("Fuse, empty messages", "/sightfix.v1.FusionService/Fuse", b"\x12\0" * (LARGE // 2)),
    (
        "ImportSamples, empty messages",
        "/sightfix.v1.SampleService/ImportSamples",
        field(1, b"c") + b"\x12\0" * (LARGE // 2 - 4),
    ),
    (
        "ModelInfer, empty tensors",
        "/inference.GRPCInferenceService/ModelInfer",
        field(1, b"c") + b"\x2a\0" * (LARGE // 2 - 4),
    ),
    (
        "ModelInfer, packed integers",
        "/inference.GRPCInferenceService/ModelInfer",
        tensor(field(3, b"\1" * (LARGE - 64))),
    ),
    (
        "ModelInfer, packed numbers",
        "/inference.GRPCInferenceService/ModelInfer",
        tensor(field(7, b"\0" * (LARGE // 8 * 8 - 64))),
    ),
    (
        "EstimateGnssError, empty messages",
        "/sightfix.v1.ModelService/EstimateGnssError",
        field(1, b"c") + b"\x12\0" * (LARGE // 2 - 4),
    ),
    ("CreateKey, empty texts", "/sightfix.v1.KeyService/CreateKey", b"\x1a\0" * (LARGE // 2)),
    ("POST fusions", "/v1/cameras/c/fusions", b'{"observations":[%b]}' % many(b"{}", SMALL)),
    ("POST infer, flat numbers", "/v2/models/c/infer", INFER % many(b"1", SMALL)),
    ("POST infer, nested lists", "/v2/models/c/infer", INFER % many(b"[]", SMALL)),
    (
        "POST infer, parameters",
        "/v2/models/c/infer",
        b'{"parameters":{"a":[%b]},"inputs":[]}' % many(b"[]", SMALL),
    ),
    ("POST gnss-error", "/v1/cameras/c/gnss-error", b'{"fixes":[%b]}' % many(b"{}", SMALL)),
    ("POST cameras, labels", "/v1/cameras", b'{"id":"d","labels":{%b}}' % LABELS),
    ("import, CSV", "/v1/cameras/c/samples", b"time,target_id,left,top,width,height\n" + b"x\n" * 2_000_000),
    ("import, JSON", "/v1/cameras/c/samples", b'{"samples":[%b]}' % many(b"{}", 3_900_000)),
    ("import, NDJSON", "/v1/cameras/c/samples", b"{}\n" * 1_300_000),
]
MEDIA_TYPES = {"import, CSV": "text/csv", "import, NDJSON": "application/x-ndjson"}


def start(folder: str) -> tuple[subprocess.Popen[str], int]:
    command = [os.environ["SIGHTFIX"], "serve", "--listen", "127.0.0.1:0", "--data", folder]
    log = open(f"{folder}.log", "w+")
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log, text=True)
    for _ in range(200):
        if found := re.search(r"127\.0\.0\.1:(\d+)", open(log.name).read()):
            return server, int(found.group(1))
        time.sleep(0.1)
    raise SystemExit("the server does not start")


def send(port: int, path: str, body: bytes, media_type: str) -> str:
    """Sends a request; its HTTP status, or that of gRPC."""
    is_grpc = media_type == "application/grpc"
    with tempfile.NamedTemporaryFile() as file, tempfile.NamedTemporaryFile() as head:
        file.write(b"\0" + struct.pack(">I", len(body)) + body if is_grpc else body)
        file.flush()
        command = ["curl", "-s", "-o", "/dev/null", "-D", head.name, "--data-binary", f"@{file.name}"]
        command += ["-H", f"content-type: {media_type}", "-H", "te: trailers"]
        command += ["--http2-prior-knowledge"] if is_grpc else []
        subprocess.run([*command, f"http://127.0.0.1:{port}{path}"], check=True)
        text = head.read().decode(errors="replace")
    return (re.findall(r"grpc-status: (\d+)", text) or re.findall(r"HTTP/\S+ (\d+)", text) or ["?"])[-1]


def peak_bytes(server: subprocess.Popen[str]) -> int:
    status = open(f"/proc/{server.pid}/status").read()
    return int(re.search(r"VmHWM:\s+(\d+)", status).group(1)) * 1024


def measure(name: str, path: str, body: bytes) -> None:
    media_type = "application/grpc" if "Service/" in path else MEDIA_TYPES.get(name, JSON)
    small = b'{"id":"x"}' if media_type != "application/grpc" else field(1, b"c")
    with tempfile.TemporaryDirectory() as folder:
        server, port = start(f"{folder}/data")
        try:
            send(port, "/v1/cameras", b'{"id":"c"}', JSON)
            model = open(MODEL, "rb").read()
            send(port, "/v1/cameras/c/models", model, "application/octet-stream")
            for _ in range(3):
                send(port, path, small, media_type)
            before = peak_bytes(server)
            status = send(port, path, body, media_type)
            ratio = (peak_bytes(server) - before) / len(body)
            print(f"| {name} | {len(body) / 1e6:.2f} MB | {status} | {ratio:.1f} |", flush=True)
        finally:
            server.kill()
            server.wait()


if __name__ == "__main__":
    print("| request | sent | status | peak per byte |\n|---|---:|---:|---:|")
    for case in CASES:
        if len(sys.argv) < 2 or sys.argv[1] in case[0]:
            measure(*case)
