"""An RTSP server on loopback, of Debian's GStreamer, for the tests; runs under the system's Python.

    /usr/bin/python3 rtsp_server.py PORT [--jpegs FOLDER] [--size 160x120] [--fps 15]

Serves rtsp://127.0.0.1:PORT/rail: the JPEGs of a folder again and again, or a test picture as
H.264. Needs gir1.2-gst-rtsp-server-1.0 and gstreamer1.0-plugins-good (for H.264 also -bad).
"""

import argparse
import itertools
from pathlib import Path

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

JPEGS = (
    "( appsrc name=pictures is-live=true format=time do-timestamp=true "
    "! jpegparse ! rtpjpegpay name=pay0 )"
)
PATTERN = (
    "( videotestsrc is-live=true pattern=ball ! video/x-raw,width={},height={},framerate={}/1 "
    "! openh264enc gop-size=15 ! rtph264pay name=pay0 config-interval=1 )"
)


class Pictures(GstRtspServer.RTSPMediaFactory):
    """Pushes the JPEGs of a folder at the rate asked for."""

    def __init__(self, folder, fps):
        super().__init__()
        self.pictures = itertools.cycle([p.read_bytes() for p in sorted(folder.glob("*.jpg"))])
        self.fps = fps
        self.set_launch(JPEGS)
        self.set_shared(True)

    def feed(self, _, media):
        source = media.get_element().get_child_by_name("pictures")
        source.set_property("caps", Gst.Caps.from_string(f"image/jpeg,framerate={self.fps}/1"))

        def push():
            data = next(self.pictures)
            return source.emit("push-buffer", Gst.Buffer.new_wrapped(data)) == Gst.FlowReturn.OK

        GLib.timeout_add(round(1000 / self.fps), push)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("port")
    parser.add_argument("--jpegs", type=Path)
    parser.add_argument("--size", default="160x120")
    parser.add_argument("--fps", type=int, default=15)
    asked = parser.parse_args()
    Gst.init(None)
    if asked.jpegs:
        factory = Pictures(asked.jpegs, asked.fps)
        factory.connect("media-configure", factory.feed)
    else:
        factory = GstRtspServer.RTSPMediaFactory()
        factory.set_launch(PATTERN.format(*asked.size.split("x"), asked.fps))
        factory.set_shared(True)
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(asked.port)
    server.get_mount_points().add_factory("/rail", factory)
    server.attach(None)
    print("serving", flush=True)
    GLib.MainLoop().run()


main()
