// Connects to a live server as a viewer does, does what it is printed, and prints what it got as JSON.
// usage: node viewer.mjs URL '[["seek", "NANOSECONDS"], ["play", 2.0, COUNT], ["episode", K], ["loop", 2.0, ROUNDS], ...]'
import protocol from "@foxglove/ws-protocol";
import { createHash } from "node:crypto";
import WebSocket from "ws";

const [url, plan] = process.argv.slice(2);
const socket = new WebSocket(url, ["foxglove.sdk.v1"]);
const client = new protocol.FoxgloveClient({ ws: socket });
const seen = { server: undefined, topics: {}, steps: [], parameters: [] };
const byId = new Map();
let now = { messages: [], states: [], wire: [] };
const PLAYBACK_STATE = 5;

// The library is older than playback control: it would call its messages an error.
const handle = socket.onmessage;
socket.onmessage = (event) => {
  const view = event.data instanceof ArrayBuffer ? new DataView(event.data) : undefined;
  if (view?.getUint8(0) !== PLAYBACK_STATE) return handle(event);
  now.states.push({
    status: view.getUint8(1),
    time: String(view.getBigUint64(2, true)),
    speed: view.getFloat32(10, true),
    seeked: view.getUint8(14) === 1,
  });
  now.wire.push([now.states.at(-1).seeked ? "seeked" : "state", now.states.at(-1).time]);
};

client.on("error", (error) => {
  console.error(error);
  process.exit(1);
});
client.on("serverInfo", (info) => {
  seen.server = info;
  now.wire.push(["session", info.sessionId]);
});
client.on("time", ({ timestamp }) => {
  now.wire.push(["time", String(timestamp)]);
});
client.on("advertise", (channels) => {
  for (const channel of channels) {
    const { topic, schemaName, schemaEncoding, encoding } = channel;
    const schema = createHash("sha256").update(channel.schema).digest("hex");
    seen.topics[topic] = { schemaName, schemaEncoding, encoding, schema };
    byId.set(client.subscribe(channel.id), topic);
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const sha256 = createHash("sha256").update(new Uint8Array(data.buffer, data.byteOffset, data.byteLength)).digest("hex");
  now.messages.push({ topic: byId.get(subscriptionId), time: String(timestamp), sha256 });
  now.wire.push([byId.get(subscriptionId), String(timestamp)]);
});
client.on("parameterValues", ({ parameters }) => {
  seen.parameters.push(parameters);
});

function control(play, speed, seek) {
  const request = Buffer.alloc(20);
  request.writeUInt8(3, 0);
  request.writeUInt8(play ? 0 : 1, 1);
  request.writeFloatLE(speed, 2);
  request.writeUInt8(seek === undefined ? 0 : 1, 6);
  request.writeBigUInt64LE(BigInt(seek ?? 0), 7);
  request.writeUInt32LE(1, 15);
  request.write("r", 19);
  socket.send(request);
}

async function until(condition) {
  while (!condition()) await new Promise((resolve) => setTimeout(resolve, 10));
}

// Until nothing has come for a while: a busy machine takes its time.
async function quiet() {
  for (let count = -1; count !== now.messages.length + now.states.length; ) {
    count = now.messages.length + now.states.length;
    await new Promise((resolve) => setTimeout(resolve, 400));
  }
}

await until(() => seen.server !== undefined && byId.size > 0 && now.messages.length > 0);
for (const [kind, value, count] of JSON.parse(plan)) {
  control(false, 1);
  await until(() => now.states.length > 0);
  await quiet();
  seen.start ??= now.wire;
  now = { messages: [], states: [], wire: [] };
  if (kind === "seek") control(false, 1, value);
  if (kind === "play") control(true, value);
  if (kind === "episode") client.setParameters([{ name: "episode", value }], "p");
  if (kind === "loop") {
    client.setParameters([{ name: "loop", value: true }], "p");
    control(true, value);
    const restarts = () => now.states.filter((state) => state.seeked).length;
    await until(() => restarts() >= count);
  }
  await until(() => now.states.length > 0 && now.messages.length >= (count ?? 1));
  if (kind !== "play" && kind !== "loop") await quiet();
  seen.steps.push({ kind, value, ...now });
}
client.close();
console.log(JSON.stringify(seen));
