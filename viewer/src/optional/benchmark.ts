// The paper's benchmark: measured, and as a dialog of the element.
export { type BenchmarkOptions, type BenchmarkResult, type BenchmarkSubject, measure } from "./benchmark/measure";
export { openBenchmark } from "./benchmark/panel";
