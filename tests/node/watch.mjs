// Watches a live server until it says goodbye, and prints what it got as JSON.
// usage: node watch.mjs URL
import protocol from "@foxglove/ws-protocol";
import WebSocket from "ws";

const socket = new WebSocket(process.argv[2], ["foxglove.sdk.v1"]);
const client = new protocol.FoxgloveClient({ ws: socket });
const seen = { topics: {}, messages: [] };
const byId = new Map();

client.on("error", (error) => {
  console.error(error);
  process.exit(1);
});
let waits = true;
client.on("advertise", (channels) => {
  for (const { id, topic, schemaName, schema } of channels) {
    seen.topics[topic] = { schemaName, schema };
    byId.set(client.subscribe(id), topic);
  }
  // What was sent before this is answered is lost; the server answers in order.
  if (waits) setTimeout(() => console.log("watching"), 300);
  waits = false;
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const bytes = Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("base64");
  seen.messages.push({ topic: byId.get(subscriptionId), time: String(timestamp), bytes });
});
client.on("close", () => {
  process.stdout.write(JSON.stringify(seen), () => process.exit(0));
});
