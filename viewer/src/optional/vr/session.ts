import type { PartHost } from "../parts/host";
export async function attach(_host: PartHost): Promise<void> {}
