// SPDX-License-Identifier: GPL-3.0-or-later
//
// A job type of Flamenco (https://flamenco.blender.org): frames of the SNeRG engine, bakes, and studies. Copy this file into the folder
// `scripts` beside the Flamenco Manager (3.6 or later). Every worker needs Blender with the SNeRG extension, and sees the settings' paths.

const JOB_TYPE = {
    label: "SNeRG",
    description: "Render frames of baked scenes, bake a field at several resolutions, or measure a study on several machines",
    settings: [
        { key: "work", type: "string", required: true, choices: ["frames", "bakes", "study"], default: "frames",
          description: "What the tasks do" },

        // Frames.
        { key: "frames", type: "string", default: "", eval: "f'{C.scene.frame_start}-{C.scene.frame_end}'",
          evalInfo: { showLinkButton: true, description: "Scene frame range" },
          description: "Frames to render. Examples: '47', '1-30', '3, 5-10, 47-327'" },
        { key: "chunk_size", type: "int32", default: 5, propargs: { min: 1 }, visible: "submission",
          description: "Frames that one task renders" },
        { key: "blendfile", type: "string", default: "", visible: "web", description: "The .blend file to render" },
        { key: "scene", type: "string", default: "", eval: "C.scene.name", visible: "web", description: "The scene of the file to render" },
        { key: "render_output", type: "string", subtype: "file_path", default: "",
          eval: "str(Path(abspath(C.scene.render.filepath)).parent / '{timestamp}' / '######')",
          description: "Path of the frames, with # for the frame number; {timestamp} becomes the time at which the job was sent. " +
            "Whole frames that are there already are kept" },
        { key: "video", type: "bool", default: true, description: "Make a video of the frames at the end, beside them" },
        { key: "fps", type: "float", default: 24, eval: "C.scene.render.fps / C.scene.render.fps_base", visible: "hidden" },
        { key: "image_file_extension", type: "string", default: ".png", eval: "C.scene.render.file_extension", visible: "hidden" },

        // Bakes and studies.
        { key: "field", type: "string", subtype: "dir_path", default: "", description: "The field to bake or to measure" },
        { key: "out", type: "string", subtype: "dir_path", default: "", description: "Folder of the baked scenes, or of the study" },
        { key: "box", type: "string", subtype: "file_path", default: "", description: "The box to bake in, JSON; the whole domain where empty" },
        { key: "bakes", type: "string", default: "",
          description: "Scenes to bake, as NAME=VOXELS along the longest side. Example: '004=128, 005=256'" },
        { key: "parts", type: "int32", default: 4, propargs: { min: 1 }, visible: "submission",
          description: "Tasks into which a study is divided" },
        { key: "options", type: "string", default: "", description: "More options of `snerg bake` or `snerg study`, as on the command line" },
        { key: "report_options", type: "string", default: "", description: "Options of the study's last task alone, such as --target-db 30" },
    ]
};

const NO_VIDEO = [".exr", ".hdr", ".dpx", ".cin"]; // frames that FFmpeg would show with wrong colours

function compileJob(job) {
    const makers = { frames: frameTasks, bakes: bakeTasks, study: studyTasks };
    const make = makers[job.settings.work];
    if (!make) {
        throw `work is '${job.settings.work}'; choose frames, bakes or study`;
    }
    const { tasks, join } = make(job.settings, job);
    for (const task of tasks) {
        join.addDependency(task);
        job.addTask(task);
    }
    job.addTask(join);
}

// Chunks of frames, each of which skips the frames that are there whole; then a check of all frames, and a video of them.
function frameTasks(settings, job) {
    need(settings, "blendfile", "frames", "render_output");
    settings.render_output = settings.render_output.replaceAll("{timestamp}", formatTimestampLocal(job.created));
    const tasks = frameChunker(settings.frames, settings.chunk_size).map((chunk) =>
        blenderTask(`render-${chunk}`, settings, [
            "--python-expr", `import bpy; bpy.ops.snerg.farm_frames(frames='${chunk}')`,
            "--render-frame", chunk.replaceAll("-", ".."), // Blender's notation of ranges
        ]));
    const all = frameChunker(settings.frames, 1e6)[0]; // one chunk
    const join = blenderTask("check-frames", settings, [
        "--python-expr", `import bpy; bpy.ops.snerg.farm_frames(frames='${all}', check=True)`,
    ]);
    if (settings.video && !NO_VIDEO.includes(settings.image_file_extension)) {
        const folder = path.dirname(settings.render_output);
        join.addCommand(author.Command("frames-to-video", {
            exe: "ffmpeg",
            fps: settings.fps,
            inputGlob: path.join(folder, `*${settings.image_file_extension}`),
            outputFile: path.join(folder, `${path.stem(settings.blendfile)}.mp4`),
            args: [
                "-c:v", "h264", "-crf", "20", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p",
                "-r", `${settings.fps}`, "-y",
            ],
        }));
    }
    return { tasks, join };
}

// A task that opens the file with the SNeRG engine, then does as `args` say. It fails where the extension is not installed.
function blenderTask(name, settings, args) {
    const task = author.Task(name, "blender");
    const scene = settings.scene ? ["--scene", settings.scene] : [];
    task.addCommand(author.Command("blender-render", {
        exe: "{blender}",
        exeArgs: "{blenderArgs}",
        argsBefore: ["--background"],
        blendfile: settings.blendfile,
        args: ["--python-exit-code", "1", ...scene, "--engine", "SNERG", "--render-output", settings.render_output, ...args],
    }));
    return task;
}

// One task a bake; then a task that opens every scene.
function bakeTasks(settings) {
    need(settings, "field", "out", "bakes");
    const bakes = settings.bakes.split(",").map((text) => {
        const found = /^\s*(\w[\w.-]*)\s*=\s*(\d+)\s*$/.exec(text);
        if (!found) {
            throw `'${text}' is no bake; give NAME=VOXELS, such as 004=128`;
        }
        return { scene: path.join(settings.out, found[1]), name: found[1], voxels: found[2] };
    });
    if (new Set(bakes.map((bake) => bake.scene)).size < bakes.length) {
        throw `two bakes of '${settings.bakes}' have the same name`;
    }
    const tasks = bakes.map((bake) =>
        snergTask(`bake-${bake.name}-${bake.voxels}`, [
            ["bake", settings.field, "--out", bake.scene, "--resolution", bake.voxels, ...common(settings)],
        ]));
    return { tasks, join: snergTask("check-scenes", bakes.map((bake) => ["info", bake.scene])) };
}

// One task a part; then the study itself, which finds every row measured, and writes the report.
function studyTasks(settings) {
    need(settings, "field", "out");
    if (!(settings.parts >= 1)) {
        throw `parts is ${settings.parts}; give 1 or more`;
    }
    const study = ["study", settings.field, "--out", settings.out, ...common(settings)];
    const tasks = [];
    for (let part = 1; part <= settings.parts; part++) {
        tasks.push(snergTask(`part-${part}-of-${settings.parts}`, [[...study, "--part", `${part}/${settings.parts}`]]));
    }
    return { tasks, join: snergTask("report", [[...study, ...shellSplit(settings.report_options || "")]]) };
}

function common(settings) {
    return [...(settings.box ? ["--box", settings.box] : []), ...shellSplit(settings.options || "")];
}

// A task of commands of `snerg`, one after the other.
function snergTask(name, commands) {
    const task = author.Task(name, "blender");
    for (const args of commands) {
        task.addCommand(author.Command("exec", { exe: "{blender}", args: ["--command", "snerg", ...args] }));
    }
    return task;
}

function need(settings, ...keys) {
    for (const key of keys) {
        if (!settings[key]) {
            throw `the setting '${key}' is empty, which '${settings.work}' needs`;
        }
    }
}
