/** Persons and bone coefficients from bytes, for any engine: `rebuilt(await readBasis(bytes), parsePerson(bytes))`. */
export { type Basis, readBasis } from "./basis";
export { FaceError } from "./errors";
export { fittedLids, type LidShape } from "./lids";
export { jointsHash, parsePayload, type Payload } from "./payload";
export { isPerson, jointPlaces, jointTurns, parsePerson, type Person, rebuilt, shapesTurn } from "./person";
export type { PersonRig } from "./person_rig";
