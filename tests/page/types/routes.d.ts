// Which reply, body and query belong to an address of the API, from its OpenAPI description (openapi.d.ts, which
// api_types.js writes), and the further fields of stored documents.
import type { components, paths } from "./openapi";

type Schemas = components["schemas"];
type Numbers = { [name: string]: number | null | undefined };
type Check = { rbe_px?: number; raz_mm?: number; nsce?: number; points?: number };

/** Fields of documents that the description allows without naming them. */
interface Unnamed {
  StepReply: { frames?: number };
  NoiseReply: { plan: { label?: string } };
  AnalysisReply: {
    label?: string; created_utc: string; software?: string; problem?: Trouble | null; inputs?: { calibration_sha256?: string };
    settings: { reference?: number; dense_step_px?: number | null };
    summary?: { steps?: StepSummary[]; steps_failed?: { [n: string]: Trouble } } | null;
  };
  GaugesReply: { steps: GaugeReadings[] };
  CalibrationReply: {
    verdict?: { level: string; reasons?: string[] }; uncertainty?: { shape_rms_mm: number; centre_z_mm: number; corner_z_mm: number; scale: number };
    checks?: { fitted?: PositionsCheck; held_out?: PositionsCheck; drift_px?: { cam1: number; cam2: number }; made?: { made: boolean; text: string }[] };
    views?: (Check & { name: string; dz_mm: number; held_out: boolean })[]; sigma?: Numbers; cam1?: Numbers; cam2?: Numbers;
    nominal?: { [cam: string]: { phd_px: number; standoff_mm: number; angle_deg: number; image_size_px: [number, number] } };
    covariance?: { names: string[]; matrix: number[][] }; image_size_px?: { [cam: string]: [number, number] };
    plan: { label?: string; source?: string | null; created_utc?: string }; taken?: TakenView[] | null;
  };
}

/** A problem as documents and events carry it. */
export type Trouble = { code?: string; remedy?: string; detail?: string; title?: string; errors?: unknown[] };
export type StepSummary = {
  n: number; valid: number; points: number; epipolar_offset_rms_px?: number; wall_s?: number; zncc_median?: { [pair: string]: number };
  epipolar_check?: { level: string; reason: string }; sigma_median_mm?: Numbers; sigma_calibration_median_mm?: Numbers | null; strain?: { noise_floor_microstrain?: Numbers }; patch?: { patch?: string; reason?: string };
  camera_motion?: Schemas["CameraMotion"] | null; dense?: Schemas["DenseFigures"] | null;
};
export type PositionsCheck = Check & { positions_mm?: { [cam: string]: number[] }; per_camera?: { [cam: string]: Check } };
export type TakenView = { index: number; camera: string; dz_mm: number; dz_commanded_mm?: number; role: string; file: string; frames: number };

/** What stands beside a standard uncertainty: its parts by cause, null where one is not known, and what it lacks. */
type Stated<Part> = { budget?: { [cause: string]: Part } | null; not_included?: string };
type Gauged = { value: number | null; sigma: number | null } & Stated<number | null>;

/** A step's gauge readings; \`missing\` is the reason for a missing value. */
export type GaugeReadings = Omit<Schemas["GaugeStep"], "lines" | "extensometers" | "areas"> & {
  lines?: { distance_px: number[]; missing: (string | null)[]; values: { [variable: string]: { value: (number | null)[]; sigma: (number | null)[]; units: string } & Stated<(number | null)[]> } }[];
  extensometers?: { missing?: string | null; values: { [quantity: string]: Gauged } }[];
  areas?: { valid: number; points: number; values: { [variable: string]: { units: string; not_included?: string; mean_budget?: { [cause: string]: number | null } | null } & { [S in "mean" | "mean_sigma" | "sd" | "rms" | "min" | "max"]: number | null } } }[];
};

// the same type, not merely one that fits: replies with few required fields fit each other
type Same<A, B> = (<T>() => T extends A ? 1 : 2) extends (<T>() => T extends B ? 1 : 2) ? true : false;
type Named<T> = { [Name in keyof Unnamed]: Same<T, Schemas[Name]> extends true ? Name : never }[keyof Unnamed];
type Whole<T> = T extends unknown ? ([Named<T>] extends [never] ? T : Omit<T, keyof Unnamed[Named<T>]> & Unnamed[Named<T>]) : never;

/** A model of the API by its name. */
export type Model<Name extends keyof Schemas> = Whole<Schemas[Name]>;

/** Data of the events, by name. */
export interface Events {
  job: Schemas["JobReply"];
  step: { test_id: string; n: number };
  result: { test_id: string; analysis_id: string };
  step_failed: { test_id: string; analysis_id: string; n: number; problem: Trouble };
  camera: { camera: string; state: string; problem?: Trouble | null };
  stage: object;
  scene: object;
  test: { test_id: string };
  calibration: { calibration_id: string };
  noise: object;
  open: object;
  lost: object;
}

// "/tests/t1/steps/3" and "/tests/{test_id}/steps/{n}" are both "tests/*/steps/*"
type Segment<Part extends string> = Part extends `{${string}}${infer Verb}` ? `*${Verb}`
  : string extends Part ? "*" : `${number}` extends Part ? "*"
  : Part extends `${infer Name}:${infer Verb}` ? (string extends Name ? `*:${Verb}` : Part) : Part;
type Canonical<Path extends string> = Path extends `/${infer Rest}` ? Canonical<Rest>
  : Path extends `${infer Head}/${infer Tail}` ? `${Segment<Head>}/${Canonical<Tail>}` : Segment<Path>;

type Method = "get" | "post" | "put" | "patch" | "delete";
type Operations<M extends Method> = {
  [Path in keyof paths as paths[Path] extends Record<M, { responses: unknown }> ? (Path extends `/api/v1${infer Rest}` ? Canonical<Rest> : never) : never]: paths[Path][M & keyof paths[Path]];
};
type Operation<M extends Method, Path extends string> = Canonical<Path> extends keyof Operations<M> ? Operations<M>[Canonical<Path>] : never;
type Json<Content> = Content extends { content: { "application/json": infer Value } } ? Value : never;

/** The path, where the API has such an operation there. */
export type Address<M extends Method, Path extends string> = Canonical<Path> extends keyof Operations<M> ? Path : never;
/** Its reply. */
export type Reply<M extends Method, Path extends string> = Operation<M, Path> extends { responses: infer Answers } ? Whole<Json<Answers[keyof Answers & (200 | 201 | 202)]>> : never;
/** Its body. */
export type Body<M extends Method, Path extends string> = Operation<M, Path> extends { requestBody?: infer Sent } ? Json<NonNullable<Sent>> : undefined;
/** Its query parameters. */
export type Query<M extends Method, Path extends string> = Operation<M, Path> extends { parameters: { query?: infer Asked } } ? { [Name in keyof Asked]?: Asked[Name] | null } : undefined;
