"""An OpenAI-compatible endpoint on loopback that answers from a script."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@contextmanager
def endpoint(answer: Callable[[list[dict[str, Any]]], str]) -> Iterator[tuple[str, list[Any]]]:
    """Base URL, and the requests it got; `answer` maps a conversation to a reply."""
    seen: list[Any] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            seen.append(body)
            text = answer(body["messages"])
            base = {"id": f"chatcmpl-{len(seen)}", "created": 0, "model": body["model"]}
            usage = {"prompt_tokens": 10, "completion_tokens": 3, "total_tokens": 13}
            if body.get("stream"):
                base["object"] = "chat.completion.chunk"
                delta = {"role": "assistant", "content": text}
                first = base | {"choices": [{"index": 0, "delta": delta, "finish_reason": None}]}
                last = base | {"choices": [{"index": 0, "delta": {}, "finish_reason": "stop"}], "usage": usage}
                payload = "".join(f"data: {json.dumps(c)}\n\n" for c in (first, last)) + "data: [DONE]\n\n"
                kind = "text/event-stream"
            else:
                message = {"role": "assistant", "content": text}
                choices = [{"index": 0, "message": message, "finish_reason": "stop"}]
                payload = json.dumps(base | {"object": "chat.completion", "choices": choices, "usage": usage})
                kind = "application/json"
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(payload.encode())))
            self.end_headers()
            self.wfile.write(payload.encode())

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/v1", seen
    finally:
        server.shutdown()
        server.server_close()
