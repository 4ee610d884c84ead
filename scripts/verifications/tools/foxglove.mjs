// What Foxglove does with a rosbridge server: it asks for the definitions, and decodes serialised messages with its readers.
//   node foxglove.mjs NODE_MODULES ws://HOST:PORT ROS_VERSION FILE
// Each message must equal one of a plain JSON subscription. FILE gets the last decoded message of each topic, as JSON.
import assert from "node:assert/strict";
import { writeFileSync } from "node:fs";
import { createRequire } from "node:module";

process.on("uncaughtException", ({ message }) => {
  console.error(`error: ${message}`);
  process.exit(1);
});
const [modules, uri, rosVersion, file] = process.argv.slice(2);
const require = createRequire(`${modules}/`);
const { parse } = require("@foxglove/rosmsg");
const two = rosVersion === "2";
const { MessageReader } = require(two ? "@foxglove/rosmsg2-serialization" : "@foxglove/rosmsg-serialization");
const WebSocket = require("ws");
globalThis.WebSocket = WebSocket; // the client is built for browsers
const roslib = require("@foxglove/roslibjs");

const TOPICS = ["/bm/counts", "/bm/posterior", "/bm/pose", "/bm/decision", "/diagnostics"];
const ENOUGH = 3;
const PATIENCE = 60_000;
const expected = Object.fromEntries(TOPICS.map((topic) => [topic, []]));
const decoded = Object.fromEntries(TOPICS.map((topic) => [topic, []]));

// Times have three spellings; rosbridge's JSON may leave header.seq out.
const fields = ({ sec, secs = sec, nanosec, nsecs = nanosec, nsec = nsecs, seq, ...others }) =>
  Object.entries(secs === undefined ? others : { secs, nsec }).sort();
const same = (one, other) => {
  if (typeof one === "number") return one === other || one === Math.fround(other); // JSON has the double of a float32
  if (one === null || typeof one !== "object" || typeof other !== "object") return one === other;
  if (one.length !== undefined) return one.length === other.length && one.every((each, at) => same(each, other[at]));
  const [ours, theirs] = [fields(one), fields(other)];
  return ours.length === theirs.length && ours.every(([name, each], at) => name === theirs[at][0] && same(each, theirs[at][1]));
};

const text = (message) => JSON.stringify(message, (_, value) => (ArrayBuffer.isView(value) ? [...value] : value));
const opened = (socket, name = "open") => new Promise((resolve, reject) => socket.on(name, resolve).on("error", reject));
const until = async (condition, otherwise) => {
  for (const end = Date.now() + PATIENCE; !condition(); await new Promise((resolve) => setTimeout(resolve, 50)))
    assert(Date.now() < end, `${otherwise()} within ${PATIENCE / 1000} s`);
};
const missing = (messages, count) => TOPICS.filter((topic) => messages[topic].length < count);

const beside = new WebSocket(uri);
await opened(beside);
beside.on("message", (data) => {
  const { topic, msg } = JSON.parse(data);
  expected[topic]?.push(msg);
});
for (const topic of TOPICS) beside.send(JSON.stringify({ op: "subscribe", topic }));
await until(() => !missing(expected, 1).length, () => `no ${missing(expected, 1)} as JSON`);

const ros = new roslib.Ros({ url: uri });
await opened(ros, "connection");
const known = await new Promise((resolve, reject) => ros.getTopicsAndRawTypes(resolve, reject));
for (const name of TOPICS) {
  const at = known.topics.indexOf(name);
  assert(at >= 0, `the server does not know ${name}`);
  const reader = new MessageReader(parse(known.typedefs_full_text[at], { ros2: two }));
  const topic = new roslib.Topic({ ros, name, messageType: known.types[at], compression: "cbor-raw", queue_length: ENOUGH });
  topic.subscribe(({ bytes }) => decoded[name].push(reader.readMessage(bytes)));
}
await until(() => !missing(decoded, ENOUGH).length, () => `no ${ENOUGH} messages of ${missing(decoded, ENOUGH)}`);
for (const topic of TOPICS)
  for (const message of decoded[topic].slice(0, ENOUGH))
    await until(
      () => expected[topic].some((each) => same(message, each)),
      () => `${topic}: ${text(message)} does not come as JSON, whose last is ${text(expected[topic].at(-1))},`,
    );
const last = Object.fromEntries(TOPICS.map((topic) => [topic, decoded[topic][ENOUGH - 1]]));
writeFileSync(file, text(last));
console.log(`${ENOUGH} messages of each of ${TOPICS.join(", ")}`);
process.exit(0);
