/** What went wrong, in one line: where, what was found, what was expected. */
export class FaceError extends Error {
  constructor(
    readonly where: string,
    readonly what: string,
  ) {
    super(`${where}: ${what}`);
    this.name = "FaceError";
  }
}

/** The bytes at a URL. */
export async function fetched(url: string): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(url);
  } catch {
    throw new FaceError(url, "can't be reached");
  }
  if (!response.ok) throw new FaceError(url, `answers ${response.status}, expected a file`);
  return response;
}
