// What users of roslib do, on a rosbridge server: one line for each check; the exit code is 1 if one failed.
//   node roslib.mjs ROSLIB_MODULE ws://HOST:PORT ROS_VERSION
import assert from "node:assert/strict";
import { pathToFileURL } from "node:url";

const [modulePath, uri, rosVersion] = process.argv.slice(2);
const { Action, ActionClient, Goal, Param, Ros, Service, SimpleActionServer, Topic } = await import(pathToFileURL(modulePath));
const PATIENCE = 20_000;
const two = rosVersion === "2";
const type = (name, kind = "msg") => (two ? name.replace("/", `/${kind}/`) : name);

const within = (promise, what) => {
  let timer;
  const late = new Promise((_, reject) => {
    timer = setTimeout(() => reject(new Error(`${what} did not come within ${PATIENCE / 1000} s`)), PATIENCE);
  });
  return Promise.race([promise, late]).finally(() => clearTimeout(timer));
};

const connect = () => {
  const ros = new Ros({ url: uri });
  return within(
    new Promise((resolve, reject) => {
      ros.on("connection", () => resolve(ros));
      ros.on("error", reject);
    }),
    "the connection",
  );
};

// An old call as a promise: its last two arguments are the callbacks.
const asked = (object, name, ...args) =>
  within(new Promise((resolve, reject) => object[name](...args, resolve, (why) => reject(new Error(why)))), name);
const called = (service, request) =>
  within(
    new Promise((resolve, reject) => service.callService(request, resolve, (why) => reject(new Error(why)))),
    service.name,
  );
// Back when the server has done all that this connection sent before.
const settled = (ros) => asked(ros, "getNodes");

const ros = await connect();
const other = await connect();
let count = 0;

// Messages that a subscription with these options hears of what is published.
const heard = async (messageType, options, messages, wanted = messages.length) => {
  const name = `/conformance/${(count += 1)}`;
  const publisher = new Topic({ ros, name, messageType });
  const subscriber = new Topic({ ros: other, name, messageType, queue_length: 100, ...options });
  const arrived = [];
  publisher.advertise();
  await settled(ros);
  const all = new Promise((resolve) => {
    const take = (message) => {
      arrived.push(message);
      if (arrived.length === wanted) resolve();
    };
    if (options.fragment_size === undefined) {
      subscriber.subscribe(take);
    } else {
      // roslib understands fragments, but has no option that asks for them
      other.on(name, (operation) => take(operation.msg));
      other.callOnConnection({ op: "subscribe", topic: name, type: messageType, queue_length: 100, ...options });
    }
  });
  await settled(other);
  for (const message of messages) publisher.publish(message);
  await within(all, `message ${arrived.length + 1} of ${wanted}`);
  subscriber.unsubscribe();
  if (options.fragment_size !== undefined) other.callOnConnection({ op: "unsubscribe", topic: name });
  publisher.unadvertise();
  await settled(other);
  return arrived;
};

const doubles = Array.from({ length: 1024 }, (_, index) => Math.sqrt(index) / 7);
const multiArray = (data) => ({ layout: { dim: [], data_offset: 0 }, data });
const text = type("std_msgs/String");
const array = type("std_msgs/Float64MultiArray");

const checks = {
  "topic: 100 messages in order": async () => {
    const messages = Array.from({ length: 100 }, (_, index) => ({ data: `message ${index} é ☃` }));
    assert.deepEqual(await heard(text, {}, messages), messages);
  },
  "topic: 1024 doubles keep every bit": async () => {
    assert.deepEqual(await heard(array, {}, [multiArray(doubles)]), [multiArray(doubles)]);
  },
  "topic: as CBOR, doubles as a typed array": async () => {
    const [message] = await heard(array, { compression: "cbor" }, [multiArray(doubles)]);
    assert.ok(message.data instanceof Float64Array, `data is ${message.data?.constructor?.name}`);
    assert.deepEqual([...message.data], doubles);
    assert.deepEqual(message.layout, { dim: [], data_offset: 0 });
  },
  "topic: as CBOR, text and numbers": async () => {
    const messages = [{ data: "é ☃" }, { data: "" }];
    assert.deepEqual(await heard(text, { compression: "cbor" }, messages), messages);
    const int64 = type("std_msgs/Int32");
    assert.deepEqual(await heard(int64, { compression: "cbor" }, [{ data: -7 }]), [{ data: -7 }]);
  },
  "topic: as CBOR, bytes": async () => {
    const [message] = await heard(type("std_msgs/UInt8MultiArray"), { compression: "cbor" }, [
      { layout: { dim: [], data_offset: 0 }, data: "AAH/" },
    ]);
    assert.deepEqual([...message.data], [0, 1, 255]);
  },
  "topic: as cbor-raw, the serialised message": async () => {
    const [message] = await heard(text, { compression: "cbor-raw" }, [{ data: "hello" }]);
    assert.ok(message.bytes instanceof Uint8Array, `bytes are ${message.bytes?.constructor?.name}`);
    assert.ok(Number.isInteger(message.secs) && Number.isInteger(message.nsecs));
    assert.equal(Buffer.from(message.bytes).includes("hello"), true);
    assert.deepEqual([...message.bytes].slice(0, two ? 8 : 4), two ? [0, 1, 0, 0, 6, 0, 0, 0] : [5, 0, 0, 0]);
  },
  "topic: as PNG": async () => {
    const messages = [multiArray(doubles), multiArray([])];
    assert.deepEqual(await heard(array, { compression: "png" }, messages), messages);
  },
  "topic: in fragments": async () => {
    const messages = [multiArray(doubles), { ...multiArray([1.5]), unit: "é☃𝄞".repeat(200) }];
    assert.deepEqual(await heard(array, { fragment_size: 100 }, messages), messages);
  },
  "topic: PNG in fragments": async () => {
    assert.deepEqual(await heard(array, { fragment_size: 500, compression: "png" }, [multiArray(doubles)]), [
      multiArray(doubles),
    ]);
  },
  "topic: sent in fragments": async () => {
    const name = `/conformance/${(count += 1)}`;
    const topic = new Topic({ ros: other, name, messageType: text });
    const message = within(new Promise((resolve) => topic.subscribe(resolve)), "the message");
    await settled(other);
    const whole = JSON.stringify({ op: "publish", topic: name, type: text, msg: { data: "in parts" } });
    for (const num of [1, 0, 2]) {
      const data = whole.slice(num * 20, num === 2 ? undefined : (num + 1) * 20);
      ros.callOnConnection({ op: "fragment", id: "f", data, num, total: 3 });
    }
    assert.deepEqual(await message, { data: "in parts" });
    topic.unsubscribe();
  },
  "topic: latched": async () => {
    const name = `/conformance/${(count += 1)}`;
    const publisher = new Topic({ ros, name, messageType: text, latch: true });
    publisher.publish({ data: "early" });
    await settled(ros);
    const late = new Topic({ ros: other, name, messageType: text });
    const message = await within(new Promise((resolve) => late.subscribe(resolve)), "the latched message");
    assert.deepEqual(message, { data: "early" });
    late.unsubscribe();
    publisher.unadvertise();
  },
  "topic: throttled, the newest comes last": async () => {
    const messages = Array.from({ length: 10 }, (_, index) => ({ data: index }));
    const arrived = await heard(type("std_msgs/Int32"), { throttle_rate: 300, queue_length: 1 }, messages, 2);
    assert.deepEqual(arrived, [{ data: 0 }, { data: 9 }]);
  },
  "topic: publishers": async () => {
    const topic = new Topic({ ros, name: "/conformance/published", messageType: text });
    topic.advertise();
    await settled(ros);
    assert.equal((await asked(topic, "getPublishers")).length, 1);
    topic.unadvertise();
  },
  "service: called and answered": async () => {
    const options = { name: "/conformance/add", serviceType: type("example_interfaces/AddTwoInts", "srv") };
    const server = new Service({ ros, ...options });
    await server.advertise((request, response) => {
      response.sum = request.a + request.b;
      return request.a !== 13;
    });
    await settled(ros);
    const client = new Service({ ros: other, ...options });
    assert.deepEqual(await called(client, { a: 2, b: 40 }), { sum: 42 });
    const many = Array.from({ length: 50 }, (_, index) => called(client, { a: index + 20, b: 1 }));
    assert.deepEqual((await Promise.all(many)).map((answer) => answer.sum), Array.from({ length: 50 }, (_, i) => i + 21));
    await assert.rejects(called(client, { a: 13, b: 0 }));
    await server.unadvertise();
    await settled(ros);
    await assert.rejects(called(client, { a: 1, b: 1 }), /does not exist/);
  },
  "service: async server, and its exception": async () => {
    const options = { name: "/conformance/async", serviceType: type("std_srvs/SetBool", "srv") };
    const server = new Service({ ros, ...options });
    await server.advertiseAsync(async (request) => {
      if (!request.data) throw new Error("only true");
      return { success: true, message: "" };
    });
    await settled(ros);
    const client = new Service({ ros: other, ...options });
    assert.deepEqual(await called(client, { data: true }), { success: true, message: "" });
    await assert.rejects(called(client, { data: false }), /only true/);
    await server.unadvertise();
  },
  "service: a time limit": async () => {
    other.callOnConnection({ op: "advertise_service", service: "/conformance/silent", type: type("std_srvs/Empty", "srv") });
    await settled(other);
    const client = new Service({ ros, name: "/conformance/silent", serviceType: type("std_srvs/Empty", "srv") });
    const answer = new Promise((resolve, reject) =>
      client.callService({}, resolve, (why) => reject(new Error(why)), 0.2),
    );
    await assert.rejects(within(answer, "the end of the call"), /silent/);
  },
  "parameters: set, get, list, delete": async () => {
    const name = two ? "/conformance_node:speed" : "/conformance/speed";
    const param = new Param({ ros, name });
    await within(new Promise((resolve, reject) => param.set({ max: 1.5 }, resolve, reject)), "set");
    assert.deepEqual(await asked(new Param({ ros: other, name }), "get"), { max: 1.5 });
    assert.ok((await asked(other, "getParams")).includes(name));
    await within(new Promise((resolve, reject) => param.delete(resolve, reject)), "delete");
    assert.ok(!(await asked(other, "getParams")).includes(name));
  },
  "rosapi: topics and types": async () => {
    const topic = new Topic({ ros, name: "/conformance/known", messageType: array });
    topic.advertise();
    await settled(ros);
    const { topics, types } = await asked(other, "getTopics");
    assert.equal(types[topics.indexOf("/conformance/known")], array);
    assert.ok(topics.includes("/rosout"));
    assert.equal(await asked(other, "getTopicType", "/conformance/known"), array);
    assert.deepEqual(await asked(other, "getTopicsForType", array), ["/conformance/known"]);
    const raw = await asked(other, "getTopicsAndRawTypes");
    assert.match(raw.typedefs_full_text[raw.topics.indexOf("/conformance/known")], /float64\[\]\s+data/);
    topic.unadvertise();
  },
  "rosapi: message details": async () => {
    const definitions = await asked(ros, "getMessageDetails", type("geometry_msgs/PoseStamped"));
    const decoded = ros.decodeTypeDefs(definitions);
    assert.equal(decoded.pose.position.x, "float64");
    assert.equal(decoded.header.frame_id, "string");
  },
  "rosapi: services": async () => {
    assert.ok((await asked(ros, "getServices")).includes("/rosapi/topics"));
    assert.match(await asked(ros, "getServiceType", "/rosapi/topics"), /^rosapi(_msgs\/srv)?\/Topics$/);
    const wanted = await asked(ros, "getServiceType", "/rosapi/topics");
    assert.deepEqual(await asked(ros, "getServicesForType", wanted), ["/rosapi/topics"]);
  },
  "rosapi: details of services": async () => {
    for (const [name, fields] of [
      ["getServiceRequestDetails", { data: "bool" }],
      ["getServiceResponseDetails", { success: "bool", message: "string" }],
    ]) {
      const { typedefs } = await asked(ros, name, type("std_srvs/SetBool", "srv"));
      assert.deepEqual(ros.decodeTypeDefs(typedefs), fields);
    }
  },
  "rosapi: nodes": async () => {
    const topic = new Topic({ ros, name: "/conformance/mine", messageType: text });
    topic.advertise();
    await settled(ros);
    const [node] = await asked(topic, "getPublishers");
    assert.ok((await asked(other, "getNodes")).includes(node));
    const details = await within(
      new Promise((resolve, reject) => other.getNodeDetails(node, resolve, (why) => reject(new Error(why)))),
      "getNodeDetails",
    );
    assert.ok(details.publishing.includes("/conformance/mine"));
    topic.unadvertise();
  },
  "action: goal, feedback, result": async () => {
    const options = { name: "/conformance/fibonacci", actionType: "example_interfaces/action/Fibonacci" };
    const server = new Action({ ros, ...options });
    server.advertise(
      (goal, id) => {
        if (goal.order < 0) return server.setFailed(id);
        if (goal.order > 100) return undefined; // until it is cancelled
        const sequence = [0, 1];
        while (sequence.length <= goal.order) {
          sequence.push(sequence.at(-1) + sequence.at(-2));
          server.sendFeedback(id, { sequence: [...sequence] });
        }
        return server.setSucceeded(id, { sequence });
      },
      (id) => server.setCanceled(id, { sequence: [] }),
    );
    await settled(ros);
    assert.deepEqual(await asked(other, "getActionServers"), [options.name]);
    const client = new Action({ ros: other, ...options });
    const feedback = [];
    const finished = (order, whenSent = () => {}) =>
      within(
        new Promise((resolve, reject) => {
          const id = client.sendGoal({ order }, resolve, (part) => feedback.push(part), (why) => reject(new Error(why)));
          whenSent(id);
        }),
        "the action's result",
      );
    assert.deepEqual(await finished(4), { sequence: [0, 1, 1, 2, 3] });
    assert.deepEqual(feedback.map((part) => part.sequence.length), [3, 4, 5]);
    await assert.rejects(finished(-1), /aborted/);
    await assert.rejects(finished(1000, (id) => client.cancelGoal(id)), /cancel/);
    server.unadvertise();
    await settled(ros);
    await assert.rejects(finished(1), /does not exist/);
  },
  // as in roslibjs's test/examples/fibonacci.example.js, with roslib's own server
  "actionlib: goal, feedback, result, cancelling": async () => {
    const options = { serverName: "/conformance/fibonacci_1", actionName: "actionlib_tutorials/FibonacciAction" };
    const server = new SimpleActionServer({ ros, ...options });
    server.on("goal", ({ order }) => {
      if (order > 100) return; // until it is cancelled
      const sequence = [0, 1];
      while (sequence.length <= order) {
        sequence.push(sequence.at(-1) + sequence.at(-2));
        server.sendFeedback({ sequence: [...sequence] });
      }
      server.setSucceeded({ sequence });
    });
    server.on("cancel", () => server.setPreempted());
    await settled(ros);
    const actionClient = new ActionClient({ ros: other, ...options });
    await settled(other);
    const sent = (order) => {
      const goal = new Goal({ actionClient, goalMessage: { order } });
      const lengths = [];
      goal.on("feedback", ({ sequence }) => lengths.push(sequence.length));
      const result = within(new Promise((resolve) => goal.on("result", resolve)), "the goal's result");
      goal.send();
      return { goal, lengths, result };
    };
    const { lengths, result } = sent(4);
    assert.deepEqual(await result, { sequence: [0, 1, 1, 2, 3] });
    assert.deepEqual(lengths, [3, 4, 5]);
    const long = sent(1000);
    await settled(other);
    long.goal.cancel();
    assert.deepEqual(await long.result, { sequence: [] });
    assert.equal(long.goal.status.status, 2); // preempted
    const last = sent(1000);
    await settled(other);
    actionClient.cancel(); // all goals, with an empty message
    await last.result;
    actionClient.dispose();
  },
  "nonsense leaves the connection served": async () => {
    for (const nonsense of [[1, 2, 3], 42, { op: "fly" }, { op: "set_level", level: "none" }]) ros.callOnConnection(nonsense);
    await settled(ros);
  },
};

delete checks[two ? "actionlib: goal, feedback, result, cancelling" : "action: goal, feedback, result"];

let failed = 0;
for (const [test, check] of Object.entries(checks)) {
  try {
    await check();
    console.log(`ok   ${test}`);
  } catch (error) {
    failed += 1;
    console.log(`FAIL ${test}: ${String(error?.message ?? error).split("\n").filter(Boolean).slice(0, 2).join(" ")}`);
  }
}
console.log(`${Object.keys(checks).length - failed} passed, ${failed} failed`);
process.exit(failed ? 1 : 0);
