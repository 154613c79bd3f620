"""An RTSP server with a track of ONVIF metadata, by GStreamer: `rtsp_server.py PORT [USER PASSWORD]`, with Debian's Python.

Each line of its standard input is an XML document, which all clients get as RTP packets (ONVIF Streaming Specification, 5.1.2.1.1).
With a user it asks for digest authentication. Needs the packages python3-gi and gir1.2-gst-rtsp-server-1.0.
"""

import struct
import sys
import threading

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtsp", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtsp, GstRtspServer  # noqa: E402, after the versions are chosen

PACKET_BYTES = 1400
# What a camera sends while it sees nobody. Without any packet the server does not describe the track.
EMPTY = b'<tt:MetadataStream xmlns:tt="http://www.onvif.org/ver10/schema"/>'
EMPTY_EVERY_MS = 200
MARKER = 0x80
PAYLOAD_TYPE = 107
CAPS = f"application/x-rtp,media=application,encoding-name=VND.ONVIF.METADATA,clock-rate=90000,payload={PAYLOAD_TYPE}"


class Track(GstRtspServer.RTSPMediaFactory):
    """The metadata of one camera, the same for all clients."""

    def __init__(self):
        super().__init__()
        self.set_launch(f'( appsrc name=documents is-live=true format=time do-timestamp=true caps="{CAPS}" ! identity name=pay0 )')
        self.set_shared(True)
        self.documents = None
        self.sequence = 0
        self.connect("media-configure", self.configure)

    def configure(self, _factory, media):
        self.documents = media.get_element().get_by_name("documents")
        GLib.timeout_add(EMPTY_EVERY_MS, lambda: self.send(EMPTY))
        media.connect("unprepared", lambda _media: setattr(self, "documents", None))

    def send(self, document):
        """Sends a document in packets, of which the last is marked. Returns false if nobody reads."""
        if self.documents is None:
            return False
        parts = [document[at : at + PACKET_BYTES] for at in range(0, len(document), PACKET_BYTES)]
        for part in parts:
            marker = MARKER if part is parts[-1] else 0
            header = struct.pack("!BBHII", 0x80, marker | PAYLOAD_TYPE, self.sequence, 0, 1)
            self.sequence = (self.sequence + 1) % 65536
            self.documents.emit("push-buffer", Gst.Buffer.new_wrapped(header + part))
        return True


def require_user(server, factory, user, password):
    auth, token = GstRtspServer.RTSPAuth(), GstRtspServer.RTSPToken()
    token.set_string("media.factory.role", "user")
    auth.set_supported_methods(GstRtsp.RTSPAuthMethod.DIGEST)
    auth.add_digest(user, password, token)
    server.set_auth(auth)
    permissions = GstRtspServer.RTSPPermissions()
    permissions.add_permission_for_role("user", "media.factory.access", True)
    permissions.add_permission_for_role("user", "media.factory.construct", True)
    factory.set_permissions(permissions)


def main():
    Gst.init(None)
    port, *user = sys.argv[1:]
    track, server, loop = Track(), GstRtspServer.RTSPServer(), GLib.MainLoop()
    server.set_address("127.0.0.1")
    server.set_service(port)
    if user:
        require_user(server, track, *user)
    server.get_mount_points().add_factory("/onvif/metadata", track)
    server.attach(None)

    def read():
        for line in sys.stdin.buffer:
            GLib.idle_add(lambda document: track.send(document) and GLib.SOURCE_REMOVE, line.rstrip(b"\n"))
        GLib.idle_add(loop.quit)

    threading.Thread(target=read, daemon=True).start()
    print("ready", flush=True)
    loop.run()


main()
