// Prints every message of a log as one line of JSON: topic, logTime and the decoded value.
// Numbers that JSON lacks are strings (NaN, Infinity, -Infinity, -0); 64-bit integers are strings, too.
import { open } from "node:fs/promises";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";

const plain = (value) => {
  if (typeof value === "bigint") return value.toString();
  if (Object.is(value, -0)) return "-0";
  if (typeof value === "number") return Number.isFinite(value) ? value : String(value);
  if (ArrayBuffer.isView(value)) return Array.from(value, plain);
  if (Array.isArray(value)) return value.map(plain);
  if (value !== null && typeof value === "object")
    return Object.fromEntries(Object.entries(value).map(([key, part]) => [key, plain(part)]));
  return value;
};

const file = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: await loadDecompressHandlers(),
});
const decoders = new Map();
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
  decoders.set(channel.id, [channel.topic, new MessageReader(definition)]);
}
for await (const message of reader.readMessages()) {
  const [topic, decoder] = decoders.get(message.channelId);
  const value = plain(decoder.readMessage(message.data));
  process.stdout.write(JSON.stringify({ topic, logTime: String(message.logTime), value }) + "\n");
}
await file.close();
