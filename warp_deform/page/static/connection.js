// The WebSocket: messages in, small JSON out, and what happens when the server goes.

const KINDS = {f4: Float32Array, u4: Uint32Array, u1: Uint8Array};

/** The head of a binary message; its arrays, each with a `shape`, stand under their names. */
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length + (-(4 + length) & 3);
  for (const [name, kind, shape] of head.arrays) {
    const count = shape.reduce((a, b) => a * b, 1);
    const array = new KINDS[kind](buffer, at, count);
    array.shape = shape;
    head[name] = array;
    at += array.byteLength + (-array.byteLength & 3);
  }
  return head;
}

/**
 * Keep a connection: `hear` is called with every message, `change` with "open" or, when it is lost,
 * "lost" (the server may come back) or "gone" (it answers, and does not know this address any more);
 * where it returns false, nobody tries again.
 */
export function connect(hear, change) {
  const here = location.href.split(/[?#]/)[0];
  let socket = null;
  const open = () => {
    socket = new WebSocket(here.replace(/^http/, "ws") + "ws");
    socket.binaryType = "arraybuffer";
    socket.onopen = () => change("open");
    socket.onmessage = event => hear(unpack(event.data));
    socket.onclose = async () => {
      const answer = await fetch(here, {cache: "no-store"}).catch(() => null);
      if (change(answer && !answer.ok ? "gone" : "lost") !== false) setTimeout(open, 1000);
    };
  };
  open();
  return message => {
    if (socket.readyState !== WebSocket.OPEN) return false;
    socket.send(JSON.stringify(message));
    return true;
  };
}
