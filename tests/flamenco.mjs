// Compiles a job as the Flamenco Manager does: it restates the rules of internal/manager/job_compilers, in Node in place of goja.
//
//     node tests/flamenco.mjs SCRIPT.js < job.json
//
// job.json: {"name", "settings", "created"}. Prints {"type": JOB_TYPE, "tasks": [{"name", "type", "commands", "dependencies"}]} as JSON.
import { readFileSync } from "node:fs";
import { posix } from "node:path";
import vm from "node:vm";

const script = readFileSync(process.argv[2], "utf8");
const submitted = JSON.parse(readFileSync(0, "utf8"));

// Only what goja's machine has: no require, no console, no timers.
const globals = {
    print: () => undefined,
    alert: () => undefined,
    frameChunker,
    formatTimestampLocal: (created) => created,
    shellSplit,
    author: { Task: task, Command: command },
    path: {
        basename: (name) => posix.basename(name),
        dirname: (name) => posix.dirname(name),
        join: (...parts) => posix.join(...parts),
        stem: (name) => posix.parse(name).name,
    },
};
const context = vm.createContext(globals);
vm.runInContext(`"use strict";\n${script}\nglobalThis.JOB_TYPE = JOB_TYPE; globalThis.compileJob = compileJob;`, context);

const tasks = [];
const job = {
    name: submitted.name,
    created: submitted.created ?? "2026-01-31_120000",
    settings: submitted.settings,
    addTask: (added) => tasks.push({ ...added, commands: [...added.commands], dependencies: [...added.dependencies] }), // Go copies
};
try {
    if (context.JOB_TYPE && submitted.settings) {
        context.compileJob(job);
    }
} catch (error) {
    console.error(typeof error === "string" ? error : error.stack);
    process.exit(1);
}
const named = tasks.map(({ name, type, commands, dependencies }) => ({ name, type, commands, dependencies: dependencies.map((d) => d.name) }));
console.log(JSON.stringify({ type: context.JOB_TYPE, settings: job.settings, tasks: named }));

function task(name, type) {
    if (!String(name ?? "").trim() || !String(type ?? "").trim()) {
        throw new Error("author.Task(name, type): name and type are required");
    }
    const made = { name: name.trim(), type: type.trim(), commands: [], dependencies: [] };
    made.addCommand = (added) => made.commands.push(added);
    made.addDependency = (other) => made.dependencies.push(other);
    return made;
}

function command(name, parameters) {
    return { name, parameters };
}

function frameChunker(range, size) {
    if (!(size >= 1)) {
        throw new Error(`invalid chunk size, must be positive number: ${size}`);
    }
    const frames = explode(range);
    const chunks = [];
    for (let i = 0; i < frames.length; i += size) {
        chunks.push(merge(frames.slice(i, i + size)));
    }
    return chunks;
}

function explode(range) {
    const found = new Set();
    for (const part of range.trim().replaceAll("..", "-").split(",")) {
        const ends = part.split("-").map((text) => (/^\s*\d+\s*$/.test(text) ? Number(text) : NaN));
        if (ends.length > 2 || ends.some(Number.isNaN)) {
            throw new Error(`invalid range "${range}": ${part}`);
        }
        for (let frame = ends[0]; frame <= ends.at(-1); frame++) {
            found.add(frame);
        }
    }
    return [...found].sort((a, b) => a - b);
}

function merge(frames) {
    const ranges = [];
    for (const frame of frames) {
        const last = ranges.at(-1);
        if (last && last[1] + 1 === frame) {
            last[1] = frame;
        } else {
            ranges.push([frame, frame]);
        }
    }
    return ranges.map(([from, to]) => (from === to ? `${from}` : from + 1 === to ? `${from},${to}` : `${from}-${to}`)).join(",");
}

// As google/shlex: quotes as in a POSIX shell.
function shellSplit(text) {
    const words = [];
    let word = null;
    for (let i = 0; i < text.length; i++) {
        const letter = text[i];
        if (letter === "'") {
            const end = text.indexOf("'", i + 1);
            if (end < 0) throw new Error("EOF found when expecting closing quote");
            word = (word ?? "") + text.slice(i + 1, end);
            i = end;
        } else if (letter === '"') {
            word ??= "";
            for (i++; text[i] !== '"'; i++) {
                if (i >= text.length) throw new Error("EOF found when expecting closing quote");
                word += text[i] === "\\" ? text[++i] : text[i];
            }
        } else if (letter === "\\") {
            word = (word ?? "") + text[++i];
        } else if (/\s/.test(letter)) {
            if (word !== null) words.push(word);
            word = null;
        } else {
            word = (word ?? "") + letter;
        }
    }
    if (word !== null) words.push(word);
    return words;
}
