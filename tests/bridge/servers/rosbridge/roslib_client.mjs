// A client with roslib of npm, version 1 or 2: PORT. Prints as JSON what it got.
const module = await import("roslib");
const ROSLIB = module.default ?? module;

const DEADLINE = 20000; // ms
const ROWS = 20;
const ros = new ROSLIB.Ros({ url: `ws://127.0.0.1:${process.argv[2]}` });

function inTime(what, promise) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(() => reject(new Error(`no answer: ${what}`)), DEADLINE);
    promise.then((value) => (clearTimeout(timer), resolve(value)), reject);
  });
}

function asked(name, ...before) {
  return inTime(name, new Promise((resolve, reject) => ros[name](...before, resolve, reject)));
}

function rows(name) {
  const topic = new ROSLIB.Topic({ ros, name, messageType: "sensor_msgs/JointState" });
  const got = [];
  const enough = new Promise((resolve) => {
    topic.subscribe((message) => {
      if (got.push(message.name.length) === ROWS) {
        topic.unsubscribe();
        resolve(got);
      }
    });
  });
  return inTime(name, enough);
}

await inTime("connection", new Promise((resolve, reject) => (ros.on("connection", resolve), ros.on("error", reject))));
const found = { topics: (await asked("getTopics")).topics, params: await asked("getParams") };
found.type = await asked("getTopicType", "yumi_left/joint_states");
found.rows = await Promise.all(["/yumi_left/joint_states", "yumi_left/joint_states"].map(rows));
const gain = new ROSLIB.Param({ ros, name: "gain" });
await inTime("set", new Promise((resolve, reject) => gain.set(3.5, resolve, reject)));
found.gain = await inTime("get", new Promise((resolve) => gain.get(resolve)));
console.log(JSON.stringify(found));
process.exit(0);
