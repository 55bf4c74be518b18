// The websocket to the server: opened again whenever it ends. Each message is answered once it is shown; the server
// sends the next one only then, so that old ones never queue up.

const RETRY_MS = [300, 1000, 2000];
const SILENT_MS = 2500; // the server sends at least every 0.5 s

export class Connection {
  // onMessage(message, body): body is the binary part, if there is one. onConnection(text): why there is no connection,
  // empty with one.
  constructor(onMessage, onConnection) {
    Object.assign(this, { onMessage, onConnection, wanted: new Set(), failures: 0, newest: performance.now() });
    setInterval(() => this.check(), 500);
    this.open();
  }

  open() {
    const address = new URL("live", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.newest = performance.now();
    socket.onopen = () => this.wanted.forEach((name) => socket.send(`show ${name}`));
    socket.onmessage = (event) => this.take(socket, event.data);
    socket.onclose = (event) => this.closed(socket, event.reason);
  }

  async take(socket, data) {
    this.newest = performance.now();
    this.failures = 0;
    this.onConnection("");
    try {
      const [message, body] = split(data);
      await this.onMessage(message, body);
    } finally {
      if (socket.readyState === WebSocket.OPEN) socket.send("ok");
    }
  }

  // Asks for a kind of message that is sent on request only, or ends that.
  request(name, wanted) {
    if (wanted) this.wanted.add(name);
    else this.wanted.delete(name);
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(`${wanted ? "show" : "hide"} ${name}`);
  }

  closed(socket, reason) {
    if (socket !== this.socket) return;
    this.onConnection(`No connection to the robot's page${reason ? `: ${reason}` : ""}. What is shown is old. STOP may not work.`);
    setTimeout(() => this.open(), RETRY_MS[Math.min(this.failures, RETRY_MS.length - 1)]);
    this.failures += 1;
    this.socket = { readyState: WebSocket.CLOSED }; // until it is open again
  }

  // A network that has gone does not end the websocket for minutes.
  check() {
    const silent_ms = performance.now() - this.newest;
    if (silent_ms < SILENT_MS || this.socket.readyState > WebSocket.OPEN) return;
    this.onConnection("No answer from the robot's page. What is shown is old. STOP may not work.");
    if (silent_ms > 2 * SILENT_MS) {
      const { socket } = this;
      this.closed(socket, "");
      socket.close();
    }
  }
}

// Text messages are JSON; binary ones have the length of their JSON in 4 bytes, the JSON, and the body.
function split(data) {
  if (typeof data === "string") return [JSON.parse(data), null];
  const length = new DataView(data).getUint32(0);
  const text = new TextDecoder().decode(new Uint8Array(data, 4, length));
  return [JSON.parse(text), data.slice(4 + length)];
}
