// roslib on Node as a client under measurement: commands of scripts/bench bridge on standard input, answers on
// standard output.   node roslib_client.mjs ROSLIB_MODULE ws://HOST:PORT
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const [modulePath, url] = process.argv.slice(2);
const { Ros, Topic } = await import(pathToFileURL(modulePath));
const messageType = "std_msgs/Float64MultiArray";
const ACK_EVERY = 50;
const print_answer = (answer) => process.stdout.write(`${JSON.stringify(answer)}\n`);
const valuesOf = (count) => Array.from({ length: count }, (_, at) => (at + 1) / 7);

const ros = new Ros({ url });
await new Promise((resolve, reject) => {
  ros.on("connection", resolve);
  ros.on("error", reject);
});
const settled = () => new Promise((resolve, reject) => ros.getNodes(resolve, reject));

const commands = {
  publish: async ({ topic: name, values, count }) => {
    const publisher = new Topic({ ros, name, messageType });
    const data = valuesOf(values);
    for (let at = 0; at < count; at += 1) {
      publisher.publish({ data });
      if (at % 100 === 99) await new Promise((resolve) => setImmediate(resolve)); // the socket's turn
    }
    publisher.publish({ data: [-1] });
    return {};
  },
  receive: async ({ topic: name, count, compression }) => {
    const acks = new Topic({ ros, name: `${name}/heard`, messageType });
    const listener = new Topic({ ros, name, messageType, compression, queue_length: 1000 });
    let seen = 0;
    let sum = 0;
    const all = new Promise((resolve) =>
      listener.subscribe((message) => {
        seen += 1;
        sum += message.data.at(-1);
        if (seen % ACK_EVERY === 0) acks.publish({ data: [seen] });
        if (seen === count) resolve();
      }),
    );
    await settled();
    print_answer("ready");
    await all;
    return { sum };
  },
  round_trip: async ({ topic: name, values, count, compression }) => {
    const publisher = new Topic({ ros, name, messageType });
    const listener = new Topic({ ros, name, messageType, compression });
    let back;
    publisher.advertise();
    listener.subscribe((message) => back(message));
    await settled();
    const data = valuesOf(values);
    const us = [];
    for (let at = 0; at < count; at += 1) {
      const started = process.hrtime.bigint();
      const answer = new Promise((resolve) => (back = resolve));
      publisher.publish({ data });
      await answer;
      us.push(Number(process.hrtime.bigint() - started) / 1e3);
    }
    listener.unsubscribe();
    publisher.unadvertise();
    return { us };
  },
};

print_answer("connected");
for await (const line of createInterface({ input: process.stdin })) {
  const command = JSON.parse(line);
  const before = process.cpuUsage();
  const answer = await commands[command.do](command);
  const { user, system } = process.cpuUsage(before);
  print_answer({ ...answer, cpu_s: (user + system) / 1e6 });
}
process.exit(0);
