// Prints the constants of each topic's schema as one line of JSON: topic, then [name, value] pairs.
import { open } from "node:fs/promises";
import { parse } from "@foxglove/rosmsg";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";

const file = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: await loadDecompressHandlers(),
});
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  const [main] = parse(new TextDecoder().decode(schema.data), { ros2: true });
  const constants = main.definitions
    .filter((field) => field.isConstant)
    .map((field) => [field.name, Number(field.value)]);
  process.stdout.write(JSON.stringify({ topic: channel.topic, constants }) + "\n");
}
await file.close();
