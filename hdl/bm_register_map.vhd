-- ================================================================================================
-- rosbayes: bm_register_map
-- The boards' register map as constants.
-- Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one.
-- MIT licence; datasheet: docs/hardware/bm_register_block.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

package bm_register_map is

  constant BAR_ADDRESS_BITS : positive := 17;

  -- SHA-256 of the map's definition, first byte in the highest bits
  constant MAP_SHA256 : std_logic_vector(255 downto 0) := x"CE45436AF122E6EA95D04BAD0F45B2E80ADBA8B53C02569F00118801536EE5B9";

  -- registers and memories: address in bytes, number of 32-bit words, what software may do
  constant ID_ADDRESS               : natural  := 16#00000#;
  constant ID_WORDS                 : positive := 1;
  constant ID_WRITABLE              : boolean  := false;
  constant MAP_VERSION_ADDRESS      : natural  := 16#00004#;
  constant MAP_VERSION_WORDS        : positive := 1;
  constant MAP_VERSION_WRITABLE     : boolean  := false;
  constant LIVENESS_ADDRESS         : natural  := 16#00008#;
  constant LIVENESS_WORDS           : positive := 1;
  constant LIVENESS_WRITABLE        : boolean  := true;
  constant PROGRAMMED_ADDRESS       : natural  := 16#0000C#;
  constant PROGRAMMED_WORDS         : positive := 1;
  constant PROGRAMMED_WRITABLE      : boolean  := false;
  constant MAP_HASH_ADDRESS         : natural  := 16#00020#;
  constant MAP_HASH_WORDS           : positive := 8;
  constant MAP_HASH_WRITABLE        : boolean  := false;
  constant IMAGE_HASH_ADDRESS       : natural  := 16#00040#;
  constant IMAGE_HASH_WORDS         : positive := 8;
  constant IMAGE_HASH_WRITABLE      : boolean  := false;
  constant CAP_MACHINE_ADDRESS      : natural  := 16#00080#;
  constant CAP_MACHINE_WORDS        : positive := 1;
  constant CAP_MACHINE_WRITABLE     : boolean  := false;
  constant CAP_LINES_ADDRESS        : natural  := 16#00084#;
  constant CAP_LINES_WORDS          : positive := 1;
  constant CAP_LINES_WRITABLE       : boolean  := false;
  constant CAP_TOTAL_LINES_ADDRESS  : natural  := 16#00088#;
  constant CAP_TOTAL_LINES_WORDS    : positive := 1;
  constant CAP_TOTAL_LINES_WRITABLE : boolean  := false;
  constant CAP_LINE_OFFSET_ADDRESS  : natural  := 16#0008C#;
  constant CAP_LINE_OFFSET_WORDS    : positive := 1;
  constant CAP_LINE_OFFSET_WRITABLE : boolean  := false;
  constant CAP_PARTITION_ADDRESS    : natural  := 16#00090#;
  constant CAP_PARTITION_WORDS      : positive := 1;
  constant CAP_PARTITION_WRITABLE   : boolean  := false;
  constant CAP_SENSORS_ADDRESS      : natural  := 16#00094#;
  constant CAP_SENSORS_WORDS        : positive := 1;
  constant CAP_SENSORS_WRITABLE     : boolean  := false;
  constant CAP_WIDTHS_ADDRESS       : natural  := 16#00098#;
  constant CAP_WIDTHS_WORDS         : positive := 1;
  constant CAP_WIDTHS_WRITABLE      : boolean  := false;
  constant CAP_BANKS_ADDRESS        : natural  := 16#0009C#;
  constant CAP_BANKS_WORDS          : positive := 1;
  constant CAP_BANKS_WRITABLE       : boolean  := false;
  constant CAP_REPLICAS_ADDRESS     : natural  := 16#000A0#;
  constant CAP_REPLICAS_WORDS       : positive := 1;
  constant CAP_REPLICAS_WRITABLE    : boolean  := false;
  constant CAP_INTERFACE_ADDRESS    : natural  := 16#000A4#;
  constant CAP_INTERFACE_WORDS      : positive := 1;
  constant CAP_INTERFACE_WRITABLE   : boolean  := false;
  constant CAP_SPEED_ADDRESS        : natural  := 16#000A8#;
  constant CAP_SPEED_WORDS          : positive := 1;
  constant CAP_SPEED_WRITABLE       : boolean  := false;
  constant CAP_STEPS_ADDRESS        : natural  := 16#000AC#;
  constant CAP_STEPS_WORDS          : positive := 1;
  constant CAP_STEPS_WRITABLE       : boolean  := false;
  constant CAP_LINK_ADDRESS         : natural  := 16#000B0#;
  constant CAP_LINK_WORDS           : positive := 1;
  constant CAP_LINK_WRITABLE        : boolean  := false;
  constant CAP_SENSOR_BITS_ADDRESS  : natural  := 16#000C0#;
  constant CAP_SENSOR_BITS_WORDS    : positive := 16;
  constant CAP_SENSOR_BITS_WRITABLE : boolean  := false;
  constant CONTROL_ADDRESS          : natural  := 16#00100#;
  constant CONTROL_WORDS            : positive := 1;
  constant CONTROL_WRITABLE         : boolean  := true;
  constant TARGET_COUNT_ADDRESS     : natural  := 16#00104#;
  constant TARGET_COUNT_WORDS       : positive := 1;
  constant TARGET_COUNT_WRITABLE    : boolean  := true;
  constant MAX_CYCLES_ADDRESS       : natural  := 16#00108#;
  constant MAX_CYCLES_WORDS         : positive := 2;
  constant MAX_CYCLES_WRITABLE      : boolean  := true;
  constant BANK_ADDRESS             : natural  := 16#00110#;
  constant BANK_WORDS               : positive := 1;
  constant BANK_WRITABLE            : boolean  := true;
  constant PRIOR_SELECT_ADDRESS     : natural  := 16#00114#;
  constant PRIOR_SELECT_WORDS       : positive := 1;
  constant PRIOR_SELECT_WRITABLE    : boolean  := true;
  constant RUN_UNTIL_ADDRESS        : natural  := 16#00118#;
  constant RUN_UNTIL_WORDS          : positive := 2;
  constant RUN_UNTIL_WRITABLE       : boolean  := true;
  constant START_ADDRESS            : natural  := 16#00120#;
  constant START_WORDS              : positive := 1;
  constant START_WRITABLE           : boolean  := true;
  constant RESUME_ADDRESS           : natural  := 16#00124#;
  constant RESUME_WORDS             : positive := 1;
  constant RESUME_WRITABLE          : boolean  := true;
  constant DONE_ADDRESS             : natural  := 16#00140#;
  constant DONE_WORDS               : positive := 1;
  constant DONE_WRITABLE            : boolean  := false;
  constant STATUS_ADDRESS           : natural  := 16#00144#;
  constant STATUS_WORDS             : positive := 1;
  constant STATUS_WRITABLE          : boolean  := false;
  constant CYCLES_ADDRESS           : natural  := 16#00148#;
  constant CYCLES_WORDS             : positive := 2;
  constant CYCLES_WRITABLE          : boolean  := false;
  constant COMPUTE_NS_ADDRESS       : natural  := 16#00150#;
  constant COMPUTE_NS_WORDS         : positive := 2;
  constant COMPUTE_NS_WRITABLE      : boolean  := false;
  constant HALT_ADDRESS             : natural  := 16#00180#;
  constant HALT_WORDS               : positive := 8;
  constant HALT_WRITABLE            : boolean  := true;
  constant SENSORS_ADDRESS          : natural  := 16#00200#;
  constant SENSORS_WORDS            : positive := 64;
  constant SENSORS_WRITABLE         : boolean  := true;
  constant KNOWN_MASK_ADDRESS       : natural  := 16#00300#;
  constant KNOWN_MASK_WORDS         : positive := 64;
  constant KNOWN_MASK_WRITABLE      : boolean  := true;
  constant PRIOR_SELECTS_ADDRESS    : natural  := 16#00400#;
  constant PRIOR_SELECTS_WORDS      : positive := 256;
  constant PRIOR_SELECTS_WRITABLE   : boolean  := true;
  constant START_STATE_ADDRESS      : natural  := 16#00800#;
  constant START_STATE_WORDS        : positive := 64;
  constant START_STATE_WRITABLE     : boolean  := true;
  constant BURN_IN_ADDRESS          : natural  := 16#00900#;
  constant BURN_IN_WORDS            : positive := 1;
  constant BURN_IN_WRITABLE         : boolean  := true;
  constant OPS_TIMEOUT_ADDRESS      : natural  := 16#00904#;
  constant OPS_TIMEOUT_WORDS        : positive := 1;
  constant OPS_TIMEOUT_WRITABLE     : boolean  := true;
  constant ORDER_ADDRESS            : natural  := 16#00908#;
  constant ORDER_WORDS              : positive := 1;
  constant ORDER_WRITABLE           : boolean  := true;
  constant SAMPLES_DONE_ADDRESS     : natural  := 16#00940#;
  constant SAMPLES_DONE_WORDS       : positive := 1;
  constant SAMPLES_DONE_WRITABLE    : boolean  := false;
  constant UNUSED_ADDRESS           : natural  := 16#00944#;
  constant UNUSED_WORDS             : positive := 1;
  constant UNUSED_WRITABLE          : boolean  := false;
  constant TIMED_OUT_BIT_ADDRESS    : natural  := 16#00948#;
  constant TIMED_OUT_BIT_WORDS      : positive := 1;
  constant TIMED_OUT_BIT_WRITABLE   : boolean  := false;
  constant STREAM_COUNT_ADDRESS     : natural  := 16#0094C#;
  constant STREAM_COUNT_WORDS       : positive := 1;
  constant STREAM_COUNT_WRITABLE    : boolean  := false;
  constant OUTCOMES_ADDRESS         : natural  := 16#01000#;
  constant OUTCOMES_WORDS           : positive := 1024;
  constant OUTCOMES_WRITABLE        : boolean  := false;
  constant RESULTS_ADDRESS          : natural  := 16#04000#;
  constant RESULTS_WORDS            : positive := 4096;
  constant RESULTS_WRITABLE         : boolean  := false;
  constant PRIOR_CODES_ADDRESS      : natural  := 16#08000#;
  constant PRIOR_CODES_WORDS        : positive := 4096;
  constant PRIOR_CODES_WRITABLE     : boolean  := true;
  constant STREAM_ADDRESS           : natural  := 16#0C000#;
  constant STREAM_WORDS             : positive := 4096;
  constant STREAM_WRITABLE          : boolean  := false;
  constant INPUTS_ADDRESS           : natural  := 16#10000#;
  constant INPUTS_WORDS             : positive := 8192;
  constant INPUTS_WRITABLE          : boolean  := true;

  -- all of these; a memory's words exist as far as the board implements them

  type block_t is record
    address  : natural;
    words    : positive;
    writable : boolean;
    memory   : boolean;
  end record block_t;

  type blocks_t is array (natural range <>) of block_t;

  constant BLOCKS : blocks_t(0 to 48) := (
    0 => (ID_ADDRESS, ID_WORDS, ID_WRITABLE, false),
    1 => (MAP_VERSION_ADDRESS, MAP_VERSION_WORDS, MAP_VERSION_WRITABLE, false),
    2 => (LIVENESS_ADDRESS, LIVENESS_WORDS, LIVENESS_WRITABLE, false),
    3 => (PROGRAMMED_ADDRESS, PROGRAMMED_WORDS, PROGRAMMED_WRITABLE, false),
    4 => (MAP_HASH_ADDRESS, MAP_HASH_WORDS, MAP_HASH_WRITABLE, false),
    5 => (IMAGE_HASH_ADDRESS, IMAGE_HASH_WORDS, IMAGE_HASH_WRITABLE, false),
    6 => (CAP_MACHINE_ADDRESS, CAP_MACHINE_WORDS, CAP_MACHINE_WRITABLE, false),
    7 => (CAP_LINES_ADDRESS, CAP_LINES_WORDS, CAP_LINES_WRITABLE, false),
    8 => (CAP_TOTAL_LINES_ADDRESS, CAP_TOTAL_LINES_WORDS, CAP_TOTAL_LINES_WRITABLE, false),
    9 => (CAP_LINE_OFFSET_ADDRESS, CAP_LINE_OFFSET_WORDS, CAP_LINE_OFFSET_WRITABLE, false),
    10 => (CAP_PARTITION_ADDRESS, CAP_PARTITION_WORDS, CAP_PARTITION_WRITABLE, false),
    11 => (CAP_SENSORS_ADDRESS, CAP_SENSORS_WORDS, CAP_SENSORS_WRITABLE, false),
    12 => (CAP_WIDTHS_ADDRESS, CAP_WIDTHS_WORDS, CAP_WIDTHS_WRITABLE, false),
    13 => (CAP_BANKS_ADDRESS, CAP_BANKS_WORDS, CAP_BANKS_WRITABLE, false),
    14 => (CAP_REPLICAS_ADDRESS, CAP_REPLICAS_WORDS, CAP_REPLICAS_WRITABLE, false),
    15 => (CAP_INTERFACE_ADDRESS, CAP_INTERFACE_WORDS, CAP_INTERFACE_WRITABLE, false),
    16 => (CAP_SPEED_ADDRESS, CAP_SPEED_WORDS, CAP_SPEED_WRITABLE, false),
    17 => (CAP_STEPS_ADDRESS, CAP_STEPS_WORDS, CAP_STEPS_WRITABLE, false),
    18 => (CAP_LINK_ADDRESS, CAP_LINK_WORDS, CAP_LINK_WRITABLE, false),
    19 => (CAP_SENSOR_BITS_ADDRESS, CAP_SENSOR_BITS_WORDS, CAP_SENSOR_BITS_WRITABLE, false),
    20 => (CONTROL_ADDRESS, CONTROL_WORDS, CONTROL_WRITABLE, false),
    21 => (TARGET_COUNT_ADDRESS, TARGET_COUNT_WORDS, TARGET_COUNT_WRITABLE, false),
    22 => (MAX_CYCLES_ADDRESS, MAX_CYCLES_WORDS, MAX_CYCLES_WRITABLE, false),
    23 => (BANK_ADDRESS, BANK_WORDS, BANK_WRITABLE, false),
    24 => (PRIOR_SELECT_ADDRESS, PRIOR_SELECT_WORDS, PRIOR_SELECT_WRITABLE, false),
    25 => (RUN_UNTIL_ADDRESS, RUN_UNTIL_WORDS, RUN_UNTIL_WRITABLE, false),
    26 => (START_ADDRESS, START_WORDS, START_WRITABLE, false),
    27 => (RESUME_ADDRESS, RESUME_WORDS, RESUME_WRITABLE, false),
    28 => (DONE_ADDRESS, DONE_WORDS, DONE_WRITABLE, false),
    29 => (STATUS_ADDRESS, STATUS_WORDS, STATUS_WRITABLE, false),
    30 => (CYCLES_ADDRESS, CYCLES_WORDS, CYCLES_WRITABLE, false),
    31 => (COMPUTE_NS_ADDRESS, COMPUTE_NS_WORDS, COMPUTE_NS_WRITABLE, false),
    32 => (HALT_ADDRESS, HALT_WORDS, HALT_WRITABLE, false),
    33 => (SENSORS_ADDRESS, SENSORS_WORDS, SENSORS_WRITABLE, true),
    34 => (KNOWN_MASK_ADDRESS, KNOWN_MASK_WORDS, KNOWN_MASK_WRITABLE, true),
    35 => (PRIOR_SELECTS_ADDRESS, PRIOR_SELECTS_WORDS, PRIOR_SELECTS_WRITABLE, true),
    36 => (START_STATE_ADDRESS, START_STATE_WORDS, START_STATE_WRITABLE, true),
    37 => (BURN_IN_ADDRESS, BURN_IN_WORDS, BURN_IN_WRITABLE, true),
    38 => (OPS_TIMEOUT_ADDRESS, OPS_TIMEOUT_WORDS, OPS_TIMEOUT_WRITABLE, true),
    39 => (ORDER_ADDRESS, ORDER_WORDS, ORDER_WRITABLE, true),
    40 => (SAMPLES_DONE_ADDRESS, SAMPLES_DONE_WORDS, SAMPLES_DONE_WRITABLE, true),
    41 => (UNUSED_ADDRESS, UNUSED_WORDS, UNUSED_WRITABLE, true),
    42 => (TIMED_OUT_BIT_ADDRESS, TIMED_OUT_BIT_WORDS, TIMED_OUT_BIT_WRITABLE, true),
    43 => (STREAM_COUNT_ADDRESS, STREAM_COUNT_WORDS, STREAM_COUNT_WRITABLE, true),
    44 => (OUTCOMES_ADDRESS, OUTCOMES_WORDS, OUTCOMES_WRITABLE, true),
    45 => (RESULTS_ADDRESS, RESULTS_WORDS, RESULTS_WRITABLE, true),
    46 => (PRIOR_CODES_ADDRESS, PRIOR_CODES_WORDS, PRIOR_CODES_WRITABLE, true),
    47 => (STREAM_ADDRESS, STREAM_WORDS, STREAM_WRITABLE, true),
    48 => (INPUTS_ADDRESS, INPUTS_WORDS, INPUTS_WRITABLE, true)
  );

  -- fields of registers that have several: lowest and highest bit
  constant MAP_VERSION_MINOR_LOW          : natural := 0;
  constant MAP_VERSION_MINOR_HIGH         : natural := 15;
  constant MAP_VERSION_MAJOR_LOW          : natural := 16;
  constant MAP_VERSION_MAJOR_HIGH         : natural := 31;
  constant CAP_MACHINE_KIND_LOW           : natural := 0;
  constant CAP_MACHINE_KIND_HIGH          : natural := 7;
  constant CAP_MACHINE_RNG_LOW            : natural := 8;
  constant CAP_MACHINE_RNG_HIGH           : natural := 15;
  constant CAP_MACHINE_SHARED_LOW         : natural := 16;
  constant CAP_MACHINE_SHARED_HIGH        : natural := 16;
  constant CAP_MACHINE_FREE_LOW           : natural := 17;
  constant CAP_MACHINE_FREE_HIGH          : natural := 17;
  constant CAP_MACHINE_PRIOR_WRITTEN_LOW  : natural := 18;
  constant CAP_MACHINE_PRIOR_WRITTEN_HIGH : natural := 18;
  constant CAP_MACHINE_SENSOR_MODE_LOW    : natural := 19;
  constant CAP_MACHINE_SENSOR_MODE_HIGH   : natural := 20;
  constant CAP_MACHINE_LITERAL_LOW        : natural := 21;
  constant CAP_MACHINE_LITERAL_HIGH       : natural := 21;
  constant CAP_MACHINE_PER_MOVE_LOW       : natural := 22;
  constant CAP_MACHINE_PER_MOVE_HIGH      : natural := 22;
  constant CAP_MACHINE_STREAM_LOW         : natural := 23;
  constant CAP_MACHINE_STREAM_HIGH        : natural := 23;
  constant CAP_PARTITION_INDEX_LOW        : natural := 0;
  constant CAP_PARTITION_INDEX_HIGH       : natural := 15;
  constant CAP_PARTITION_COUNT_LOW        : natural := 16;
  constant CAP_PARTITION_COUNT_HIGH       : natural := 31;
  constant CAP_WIDTHS_PROB_BITS_LOW       : natural := 0;
  constant CAP_WIDTHS_PROB_BITS_HIGH      : natural := 7;
  constant CAP_WIDTHS_COUNTER_BITS_LOW    : natural := 8;
  constant CAP_WIDTHS_COUNTER_BITS_HIGH   : natural := 15;
  constant CAP_WIDTHS_PRIOR_BITS_LOW      : natural := 16;
  constant CAP_WIDTHS_PRIOR_BITS_HIGH     : natural := 23;
  constant CAP_INTERFACE_SENSORS_LOW      : natural := 0;
  constant CAP_INTERFACE_SENSORS_HIGH     : natural := 15;
  constant CAP_INTERFACE_RESULTS_LOW      : natural := 16;
  constant CAP_INTERFACE_RESULTS_HIGH     : natural := 31;
  constant CAP_SENSOR_BITS_FIRST_LOW      : natural := 0;
  constant CAP_SENSOR_BITS_FIRST_HIGH     : natural := 7;
  constant CAP_SENSOR_BITS_SECOND_LOW     : natural := 8;
  constant CAP_SENSOR_BITS_SECOND_HIGH    : natural := 15;
  constant CAP_SENSOR_BITS_THIRD_LOW      : natural := 16;
  constant CAP_SENSOR_BITS_THIRD_HIGH     : natural := 23;
  constant CAP_SENSOR_BITS_FOURTH_LOW     : natural := 24;
  constant CAP_SENSOR_BITS_FOURTH_HIGH    : natural := 31;
  constant CONTROL_RESET_LOW              : natural := 0;
  constant CONTROL_RESET_HIGH             : natural := 0;
  constant CONTROL_INTERRUPT_ENABLE_LOW   : natural := 1;
  constant CONTROL_INTERRUPT_ENABLE_HIGH  : natural := 1;
  constant STATUS_STATE_LOW               : natural := 0;
  constant STATUS_STATE_HIGH              : natural := 3;
  constant STATUS_STOP_REASON_LOW         : natural := 4;
  constant STATUS_STOP_REASON_HIGH        : natural := 7;
  constant STATUS_ERROR_LOW               : natural := 8;
  constant STATUS_ERROR_HIGH              : natural := 15;

  -- machine kind
  constant MACHINE_KIND_NONE : natural := 0;
  constant MACHINE_KIND_BM1  : natural := 1;
  constant MACHINE_KIND_BM2  : natural := 2;

  -- rng kind
  constant RNG_KIND_NONE   : natural := 0;
  constant RNG_KIND_LFSR8  : natural := 1;
  constant RNG_KIND_LFSR16 : natural := 2;
  constant RNG_KIND_LFSR24 : natural := 3;
  constant RNG_KIND_LFSR32 : natural := 4;
  constant RNG_KIND_TABLE  : natural := 5;
  constant RNG_KIND_IDEAL  : natural := 6;

  -- sensor mode
  constant SENSOR_MODE_COLUMN    : natural := 0;
  constant SENSOR_MODE_CELL      : natural := 1;
  constant SENSOR_MODE_THRESHOLD : natural := 2;

  -- board state
  constant BOARD_STATE_BLANK   : natural := 0;
  constant BOARD_STATE_IDLE    : natural := 1;
  constant BOARD_STATE_RUNNING : natural := 2;
  constant BOARD_STATE_DONE    : natural := 3;

  -- stop reason
  constant STOP_REASON_NONE       : natural := 0;
  constant STOP_REASON_OVERFLOW   : natural := 1;
  constant STOP_REASON_MAX_CYCLES : natural := 2;
  constant STOP_REASON_SLICE      : natural := 3;
  constant STOP_REASON_IMPOSSIBLE : natural := 4;
  constant STOP_REASON_TIMEOUT    : natural := 5;
  constant STOP_REASON_FULL       : natural := 6;

  -- error code
  constant ERROR_CODE_NONE       : natural := 0;
  constant ERROR_CODE_OUTSIDE    : natural := 1;
  constant ERROR_CODE_MISALIGNED : natural := 2;
  constant ERROR_CODE_TOO_LONG   : natural := 3;
  constant ERROR_CODE_READ_ONLY  : natural := 4;
  constant ERROR_CODE_BUSY       : natural := 5;
  constant ERROR_CODE_BLANK      : natural := 6;
  constant ERROR_CODE_DOORBELL   : natural := 7;
  constant ERROR_CODE_BAD_VALUE  : natural := 8;
  constant ERROR_CODE_STALE      : natural := 9;
  constant ERROR_CODE_HELD       : natural := 10;
  constant ERROR_CODE_BAD_FRAME  : natural := 11;
  constant ERROR_CODE_BAD_IMAGE  : natural := 12;

end package bm_register_map;
