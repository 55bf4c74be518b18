// Every message of an MCAP log, decoded as Foxglove and Lichtblick decode it: one line of JSON for each on stdout.
//   node read_log.mjs FILE.mcap
// Attachments and the profile come first. Bytes are given by length and SHA-256, clouds point by point, times as s and ns.
import { createHash } from "node:crypto";
import { open } from "node:fs/promises";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";

const FLOAT32 = 7; // sensor_msgs/msg/PointField

const digest = (bytes) => ({ bytes: bytes.length, sha256: createHash("sha256").update(bytes).digest("hex") });

function plain(name, value) {
  if (value instanceof Uint8Array) return digest(value);
  if (ArrayBuffer.isView(value)) return Array.from(value);
  if (typeof value === "number" && !Number.isFinite(value)) return String(value);
  return typeof value === "bigint" ? value.toString() : value;
}

function points(cloud) {
  const view = new DataView(cloud.data.buffer, cloud.data.byteOffset, cloud.data.byteLength);
  const read = (field, start) => {
    if (field.datatype !== FLOAT32) throw new Error(`field ${field.name} has type ${field.datatype}`);
    return view.getFloat32(start + field.offset, !cloud.is_bigendian);
  };
  return Array.from({ length: cloud.width * cloud.height }, (_, i) =>
    cloud.fields.map((field) => read(field, i * cloud.point_step)));
}

function say(line) {
  process.stdout.write(JSON.stringify(line, (name, value) => plain(name, value)) + "\n");
}

const file = await open(process.argv[2], "r");
const log = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: await loadDecompressHandlers(),
});
const attachments = {};
for await (const attachment of log.readAttachments()) attachments[attachment.name] = digest(attachment.data);
say({ profile: log.header.profile, attachments });
const readers = new Map();
for await (const message of log.readMessages()) {
  const channel = log.channelsById.get(message.channelId);
  const schema = log.schemasById.get(channel.schemaId);
  if (!readers.has(schema.id)) {
    readers.set(schema.id, new MessageReader(parse(new TextDecoder().decode(schema.data), { ros2: true })));
  }
  const said = readers.get(schema.id).readMessage(message.data);
  const cloud = schema.name === "sensor_msgs/msg/PointCloud2" ? { points: points(said) } : {};
  say({ topic: channel.topic, schema: schema.name, log_ns: message.logTime, message: { ...said, ...cloud } });
}
await file.close();
