// Reads MCAP files as Foxglove does; prints what it found in each as one line of JSON.
import { readFileSync } from "node:fs";
import { McapIndexedReader } from "@mcap/core";
import * as support from "@mcap/support";

const { loadDecompressHandlers, protobufFromBinaryDescriptor } = support.default ?? support;

async function read(path) {
  const bytes = new Uint8Array(readFileSync(path));
  const readable = {
    size: async () => BigInt(bytes.byteLength),
    read: async (offset, size) => bytes.subarray(Number(offset), Number(offset + size)),
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
  const types = new Map();
  for (const channel of reader.channelsById.values()) {
    const schema = reader.schemasById.get(channel.schemaId);
    types.set(channel.id, protobufFromBinaryDescriptor(schema.data).lookupType(schema.name));
  }
  const found = { channels: [...reader.channelsById.values()].map((c) => c.topic).sort(), rows: [], metadata: [] };
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const values = types.get(message.channelId).decode(message.data);
    if (reader.channelsById.get(message.channelId).topic === "/sample") {
      const row = { ...values, log_time: Number(message.logTime), sequence: message.sequence };
      for (const [key, value] of Object.entries(row)) row[key] = Number.isNaN(Number(value)) ? "nan" : Number(value);
      found.rows.push(row);
    }
  }
  for await (const record of reader.readMetadata()) found.metadata.push([record.name, record.metadata.get("json")]);
  found.messages = Number(reader.statistics.messageCount);
  return found;
}

for (const path of process.argv.slice(2)) console.log(JSON.stringify(await read(path)));
