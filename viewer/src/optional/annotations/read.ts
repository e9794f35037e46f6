// annotations.json.
import { type FileSource, readJson } from "../../data/files";
import { isArray } from "../../data/scene";
import { EXPORT_AGAIN, ViewerError } from "../../errors";

export interface Annotation {
  text: string;
  position: [number, number, number]; // Blender's axes
  camera?: string; // the name of one to fly to
}

/** The annotations of a bundle. Rejects with a ViewerError where the file is missing or damaged. */
export async function readAnnotations(source: FileSource): Promise<Annotation[]> {
  const value = (await readJson(source, "annotations.json")) as { annotations?: unknown } | null;
  if (!Array.isArray(value?.annotations) || !value.annotations.every(isAnnotation)) {
    throw new ViewerError(`The file annotations.json is damaged: it is not a list of annotations. ${EXPORT_AGAIN}`);
  }
  return value.annotations;
}

function isAnnotation(value: Annotation | null): boolean {
  return (
    value !== null &&
    typeof value === "object" &&
    typeof value.text === "string" &&
    isArray(value.position, [3]) &&
    (value.camera === undefined || typeof value.camera === "string")
  );
}
